"""Segments of Metaworld are drawn by collecting them again (``-m slow``: it needs a renderer)."""

import os

import pytest
import torch

from popl_rl.envs.metaworld_tasks import metaworld

pytestmark = pytest.mark.slow


@pytest.mark.skipif(os.environ.get("MUJOCO_GL") != "egl", reason="needs MUJOCO_GL=egl")
def test_a_segment_is_drawn_as_it_was_collected():
    env = metaworld("drawer-open", size=64)
    segments = env.collect_segments(8, 10, generator=torch.Generator().manual_seed(3))
    films = {}
    env.record_segments(
        segments, [5], films.__setitem__, generator=torch.Generator().manual_seed(3)
    )
    assert list(films) == [5]
    assert len(films[5]) == 4  # before steps 0, 4 and 8, and at the end
    assert films[5][0].shape == (64, 64, 3)
    assert (films[5][0] != films[5][-1]).any()
    other = torch.Generator().manual_seed(4)
    with pytest.raises(ValueError, match="segment 5 cannot be drawn"):
        env.record_segments(segments, [5], films.__setitem__, generator=other)
    env.close()
