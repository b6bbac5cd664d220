import pytest
import torch
from tensordict import TensorDict

from popl_rl.envs.hidden_plane import hidden_plane, plane
from popl_rl.envs.hidden_utility import sample_states
from popl_rl.raters.groups import make_groups
from popl_rl.testing import check_rater


def row(x, y, coin):
    return TensorDict({"observation": torch.tensor([[[x, y]]]), "info": {"coin": [[coin]]}}, [1, 1])


@pytest.mark.parametrize(
    ("x", "y", "coin", "expected"),
    [
        (0.0, 0.5, 0.9, 0.5),  # certain
        (0.5, 0.5, 0.7, 2 / 3),  # 1 - xy = 3/4
        (0.5, 0.5, 0.75, 0.0),
        (1.0, 0.75, 0.2, 3.0),
        (1.0, 0.75, 0.3, 0.0),
        (1.0, 1.0, 0.0, 0.0),
        (0.3, 0.0, 0.5, 0.0),
    ],
)
def test_utility_by_hand(x, y, coin, expected):
    assert plane(row(x, y, coin)).tolist() == [[pytest.approx(expected)]]


def test_it_is_worth_y_on_average(generator):
    segments = sample_states(200_000, dimensions=2, generator=generator)
    y, utility = segments["observation"][:, 0, 1], plane(segments)[:, 0]
    assert utility.isfinite().all()
    for low in (0.0, 0.25, 0.5):
        chosen = (y >= low) & (y < low + 0.25)
        assert utility[chosen].mean().item() == pytest.approx(low + 0.125, abs=0.02)


def test_states_need_two_coordinates(generator):
    (group,) = make_groups(["plane"], label="return")
    for dimensions in (1, 3):
        segments = sample_states(4, dimensions=dimensions, generator=generator)
        with pytest.raises(ValueError, match=f"2 coordinates, got {dimensions}; take env=hidden_p"):
            group.segment_utility(segments)
    with pytest.raises(ValueError, match="judges states of 2 coordinates, got 1"):
        check_rater("plane", "hidden_utility")
    check_rater("plane", "hidden_utility", dimensions=2)


def test_the_environment_has_two_coordinates():
    env = hidden_plane(max_steps=5)
    assert env.observation_space.shape == (2,)
    assert env.max_steps == 5
    with pytest.raises(ValueError, match="render_mode must be None"):
        hidden_plane(render_mode="human")
