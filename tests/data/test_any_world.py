# ruff: noqa: ARG002, ARG005 - Gymnasium's names of arguments
"""What people's own environments do that shipped ones do not."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl import registry
from popl_rl.data.environments import make_world, offered
from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.data.segments import collect_segments


class Blinking(gymnasium.Env):
    """Says nothing at reset, something at each step, and ``goal`` at the last one only."""

    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {"speed": None}

    def step(self, action):
        self.time += 1
        info = {"speed": 0.5 * self.time, "text": "no number"}
        if self.time == 3:
            info["goal"] = True
        return np.full(1, self.time, np.float32), 0.0, self.time == 3, False, info


class Guided(gymnasium.Wrapper):
    """A wrapper that offers what the environment within does not."""

    def behaviours(self):
        return {"ones": lambda step, generator: torch.ones(step.batch_size, dtype=torch.long)}

    def collect_segments(self, num_segments, length, *, generator, progress=None):
        shape = (num_segments, length)
        steps = {"observation": torch.full((*shape, 1), 7.0), "action": torch.zeros(shape).long()}
        return TensorDict(steps, shape)


def guided():
    return gymnasium.wrappers.TimeLimit(Guided(Blinking()), 7)


def test_numbers_that_no_reset_gives_are_kept_and_0_where_they_are_missing():
    shown = []

    def act(step):
        shown.append(sorted(step["info"].keys()))
        return torch.zeros(2, dtype=torch.long)

    episodes = lockstep([Blinking(), Blinking()], act, seeds=[0, 1], max_steps=5)
    assert episodes[MASK].all()
    assert episodes["info", "speed"].tolist() == [[0.5, 1.0, 1.5]] * 2
    assert episodes["info", "goal"].tolist() == [[0, 0, 1]] * 2
    assert shown == [[], ["speed"], ["speed"]]


def test_batches_with_different_numbers_are_one_data_set():
    class Rare(Blinking):
        made = 0

        def __init__(self):
            Rare.made += 1
            self.number = Rare.made
            self.episodes = 0

        def reset(self, **kwargs):
            self.episodes += 1
            return super().reset(**kwargs)

        def step(self, action):
            *outcome, info = super().step(action)
            return *outcome, {"bump": 2.0, **info} if self.episodes == 2 else info

    def act(step, generator):
        return torch.zeros(step.batch_size, dtype=torch.long)

    segments = collect_segments(
        Rare,
        {"one": act},
        num_segments=8,
        length=3,
        generator=torch.Generator().manual_seed(0),
        num_envs=4,
    )
    assert sorted(segments["info", "bump"].sum(1).tolist()) == [0.0] * 4 + [6.0] * 4


def test_what_a_wrapper_offers_is_used():
    with registry.isolated():
        registry.env("guided")(guided)
        world = make_world("guided")
    assert list(world.behaviours) == ["ones"]
    assert world.collect is not None
    collected = world.collect(2, 3, generator=torch.Generator())
    assert collected["observation"].unique().tolist() == [7]
    assert offered(world.env, "transition_table") is None


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_ids_of_installed_packages_are_found():
    env = make_world("gymnasium:make", env_id="CartPole-v1").env
    assert env.spec.id == "CartPole-v1"
    with pytest.raises(ValueError, match=r"Nothing-v0.*env.id=minigrid:MiniGrid-Empty-5x5-v0"):
        make_world("gymnasium:make", env_id="Nothing-v0")
