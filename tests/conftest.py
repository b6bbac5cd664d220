"""Small things that many tests need; the world is the line of five cells of popl_rl.testing."""

import pytest
import torch

from popl_rl.comparisons import Comparisons
from popl_rl.preferences import collect_preferences
from popl_rl.raters import Raters, make_groups
from popl_rl.segments import SegmentBank, collect_segments, random_behaviour, segment_buffer
from popl_rl.testing import likes_left, likes_right, tiny_env

# Small tensors are slower on several threads, and tests share their cores.
torch.set_num_threads(1)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def env():
    return tiny_env(max_steps=8)


@pytest.fixture(scope="session")
def _walks():
    return collect_segments(
        lambda: tiny_env(max_steps=8),
        {"random": random_behaviour(tiny_env().action_space)},
        num_segments=40,
        length=4,
        generator=torch.Generator().manual_seed(0),
        num_envs=8,
    )


@pytest.fixture
def segments(_walks):
    """40 random walks of 4 steps."""
    return _walks.clone()


@pytest.fixture
def bank(segments):
    return SegmentBank.from_segments(segments)


@pytest.fixture
def groups():
    """Raters who want to be at the left end, and raters who want to be at the right end."""
    return make_groups([likes_left, likes_right], label="return")


@pytest.fixture
def preferences(segments, groups):
    """15 answers of each of 8 raters, the first four of group 0."""
    raters = Raters(groups, torch.tensor([0] * 4 + [1] * 4))
    buffer = collect_preferences(
        segment_buffer(segments),
        raters,
        answers_per_rater=15,
        generator=torch.Generator().manual_seed(1),
    )
    return buffer[:].exclude("index")


@pytest.fixture
def comparisons(preferences):
    """The strict preferences, a case for each rater."""
    return Comparisons.from_preferences(preferences, cases="rater")
