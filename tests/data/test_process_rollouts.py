"""Environments that step in other processes give the episodes of one, to the bit."""

import pytest
import torch

from popl_rl.data.environments import make_world
from popl_rl.data.segments import collect_segments
from popl_rl.data.table_rollouts import Rollouts
from popl_rl.evaluation.measures import roll_out
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population

ODD = """
import gymnasium
import numpy as np


class Odd(gymnasium.Env):
    '''Episodes of different lengths, and infos with different names and kinds of numbers.'''

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), dtype=np.float32)
    action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 9))
        self.first = self.left
        return np.array([self.left, 0], np.float32), {"left": self.left, "word": "begin"}

    def step(self, action):
        if self.first == 3 and self.left == 2:
            raise RuntimeError("broken")
        self.left -= 1
        info = {"left": np.int32(self.left), "even": self.left % 2 == 0}
        if self.left < 4:
            info["late"] = 0.5 if self.first % 2 else True
        return np.array([self.left, action], np.float32), 1.0, self.left == 0, False, info


class Whole(Odd):
    def step(self, action):
        self.first = max(self.first, 4)
        return super().step(action)
"""


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    file = tmp_path_factory.mktemp("odd") / "odd.py"
    file.write_text(ODD)
    return file


def assert_equal(one, other):
    assert one.batch_size == other.batch_size
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert one[key].dtype == other[key].dtype, key
        assert torch.equal(one[key], other[key]), key


def test_episodes_of_any_length_and_any_infos(odd, workers):
    world = make_world(f"{odd}:Whole")
    episodes = []
    for where in (None, workers):
        draws = torch.Generator().manual_seed(0)

        def act(step, draws=draws):
            return torch.randint(3, step.batch_size, generator=draws)

        with Rollouts(world.make, where) as roll:
            # More environments the second time, and some that began before begin again.
            episodes.append([roll(act, seeds=range(n), max_steps=20) for n in (3, 12, 1)])
    for alone, together in zip(*episodes, strict=True):
        assert_equal(alone, together)
    assert len(set(episodes[0][1]["mask"].sum(1).tolist())) > 2


def test_segments_and_evaluations(workers):
    world = make_world("gymnasium:make", env_id="CartPole-v1")
    spec = PolicySpec.from_env(world.env, hidden=(8,))
    policies = PolicySet(Population.create(spec, 3, generator=torch.Generator().manual_seed(0)))
    found = []
    for where in (None, workers):
        segments = collect_segments(
            world.make,
            world.behaviours,
            num_segments=20,
            length=5,
            num_envs=6,
            generator=torch.Generator().manual_seed(1),
            workers=where,
        )
        how = {"episodes": 4, "max_steps": 30, "seed": 2, "workers": where}
        found.append((segments, roll_out(world.make, policies, **how)))
    for alone, together in zip(*found, strict=True):
        assert_equal(alone, together)


def test_what_fails_elsewhere_is_told_as_here(odd, workers):
    world = make_world(f"{odd}:Odd")
    with (
        Rollouts(world.make, workers) as roll,
        pytest.raises(ValueError, match=r"step failed with RuntimeError: broken .*odd\.py"),
    ):
        roll(lambda step: torch.zeros(step.batch_size).long(), seeds=range(40), max_steps=9)
