"""The line of five cells, two groups, and a few preferences of theirs."""

import pytest

from popl_rl.config import DataConfig, EnvConfig, RatersConfig
from popl_rl.experiments.data import build_groups, build_world, make_data

TINY = EnvConfig(factory="popl_rl.testing:tiny_env", options={"max_steps": 8})
LEFT_RIGHT = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]


@pytest.fixture
def world():
    return build_world(TINY)


@pytest.fixture
def asked():
    """Six raters, ten answers of each."""
    return RatersConfig(groups=LEFT_RIGHT, count=6, answers=10)


@pytest.fixture
def tiny_groups(world, asked):
    return build_groups(asked, world)


@pytest.fixture
def collect(asked):
    """Collects segments of four steps and what the raters say of them, as a run does."""

    def make(world, groups, *, seed=0, load=None, segments=30, **arguments):
        data = DataConfig(segments=segments, length=4, **arguments)
        env = EnvConfig(max_steps=8)
        return make_data(data, asked, world, groups, seed=seed, env=env, load=load)

    return make
