"""Speed of rollouts of many policies in lockstep beside a bare loop over the environments.

    pytest tests/benchmarks/bench_rollouts.py -m benchmark

The bare loop resets the same environments from the same seeds and gives them the actions that the
policies took, one episode after the other; it records nothing. A ratio is the share of its steps
per second that remains with the policies asked and everything recorded.
"""

import importlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import minigrid  # noqa: F401 - registers its environments
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.data.table_rollouts import Rollouts
from popl_rl.envs.goal_grid import goal_grid
from popl_rl.envs.metaworld_tasks import MetaworldTask
from popl_rl.envs.two_doors import two_doors
from popl_rl.evaluation.optimum import action_probabilities
from popl_rl.keys import INFO, OBSERVATION
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]


class Plain(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Metaworld with observations in single precision, seeded by ``reset``, cut after a while."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        shape = env.observation_space.shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.env.unwrapped.seed(seed)  # type: ignore[attr-defined]  # reset ignores its own
        observation, _ = self.env.reset(seed=seed, options=options)
        return observation.astype(np.float32), {"success": 0.0, "grasp_success": 0.0}

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        kept = {name: float(info[name]) for name in ("success", "grasp_success")}
        return observation.astype(np.float32), float(reward), terminated, truncated, kept


def drawer() -> gymnasium.Env[Any, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("metaworld")  # registers its environments
        env = gymnasium.make(
            "Meta-World/MT1", env_name="drawer-open-v3", seed=0, disable_env_checker=True
        )
    return Plain(env)


class Flat(gymnasium.ObservationWrapper[Any, Any, Any]):
    """MiniGrid's picture of what the agent sees and its direction, as one vector."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(0, 255, (148,), np.float32)

    def observation(self, observation: Any) -> Any:
        return np.append(observation["image"], observation["direction"]).astype(np.float32)


def door_key() -> gymnasium.Env[Any, Any]:
    return Flat(gymnasium.make("MiniGrid-DoorKey-8x8-v0", disable_env_checker=True))


MAKERS = {"two_doors": two_doors, "DoorKey-8x8": door_key, "drawer-open-v3": drawer}


def bare(
    envs: Sequence[gymnasium.Env[Any, Any]], seeds: Sequence[int], actions: Sequence[Any]
) -> None:
    for env, seed, plan in zip(envs, seeds, actions, strict=True):
        env.reset(seed=seed)
        for action in plan:
            env.step(action)


def rollouts(
    envs: list[Any], count: int, *, hidden: tuple[int, ...], max_steps: int
) -> tuple[Callable[[], TensorDictBase], list[int], list[Any]]:
    """Episodes of ``count`` policies in lockstep, their seeds, and the actions that they took."""
    spec, episodes = PolicySpec.from_env(envs[0], hidden=hidden), len(envs) // count
    draws = torch.Generator().manual_seed(0)
    policies = PolicySet(Population.create(spec, count, generator=draws))
    seeds = torch.randint(2**31, (episodes,), generator=draws).tolist() * count

    def roll() -> TensorDictBase:
        generator = torch.Generator().manual_seed(1)

        def act(step: TensorDictBase) -> Tensor:
            observation = step[OBSERVATION].view(count, episodes, -1)
            return policies.act(observation, generator=generator).flatten(0, 1)

        return lockstep(envs, act, seeds=seeds, max_steps=max_steps)

    return roll, seeds, [row["action"][row[MASK]].numpy() for row in roll().unbind(0)]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "count", "episodes", "max_steps", "hidden", "least"),
    [
        ("DoorKey-8x8", 16, 4, 100, (64, 64), 0.6),
        ("drawer-open-v3", 8, 2, 100, (256, 256), 0.6),
        # Its steps take a sixth of the time of MiniGrid's own, so that asking a policy shows.
        ("two_doors", 16, 4, 100, (64, 64), 0.35),
        ("two_doors", 64, 4, 100, (64, 64), 0.35),
    ],
)
def test_lockstep(
    race: Any,
    name: str,
    count: int,
    episodes: int,
    max_steps: int,
    hidden: tuple[int, ...],
    least: float,
) -> None:
    envs = [MAKERS[name]() for _ in range(count * episodes)]
    roll, seeds, actions = rollouts(envs, count, hidden=hidden, max_steps=max_steps)
    steps = sum(map(len, actions))
    ratio = race(
        f"{count} policies x {episodes} episodes of {name}, {steps} steps",
        roll,
        lambda: bare(envs, seeds, actions),
        reference="bare env.step",
        target=0.75,
        rounds=7,
    )
    for env in envs:
        env.close()
    assert ratio > least


@pytest.mark.filterwarnings("ignore")
def test_tasks_of_metaworld(race: Any) -> None:
    """Our environments of a task, which measure more, beside Metaworld's own."""
    count, episodes, max_steps = 8, 4, 100
    envs = [MetaworldTask("drawer-open", terminate=False) for _ in range(count * episodes)]
    theirs = [drawer() for _ in envs]
    roll, seeds, actions = rollouts(envs, count, hidden=(256, 256), max_steps=max_steps)
    steps = sum(map(len, actions))
    ratio = race(
        f"{count} policies x {episodes} episodes of drawer-open as our task, {steps} steps",
        roll,
        lambda: bare(theirs, seeds, actions),
        reference="bare env.step of Metaworld's",
        target=0.9,
        rounds=7,
    )
    for env in [*envs, *theirs]:
        env.close()
    assert ratio > 0.6


@pytest.mark.parametrize(
    ("make", "acts", "least"),
    [
        (two_doors, "tables", 15),
        (two_doors, "networks", 7),  # which take most of the time
        (goal_grid, "tables", 6),  # its own steps take a quarter of the time of Minigrid's
    ],
)
def test_table(race: Any, make: Any, acts: str, least: float) -> None:
    """As many episodes as an evaluation rolls, looked up in the table of transitions."""
    count, episodes, max_steps = 16, 200, 60
    env = make()
    draws = torch.Generator().manual_seed(0)
    spec = PolicySpec.from_env(env, hidden=(64, 64))
    policies = PolicySet(Population.create(spec, count, generator=draws))
    tables = action_probabilities(policies, env.transition_table())
    member = torch.arange(count).repeat_interleave(episodes)
    seeds = torch.randint(2**31, (episodes,), generator=draws).tolist() * count

    def roll() -> TensorDictBase:
        generator = torch.Generator().manual_seed(1)

        def act(step: TensorDictBase) -> Tensor:
            if acts == "tables":
                rows = tables[member, step[INFO, "next_state"]]
                return torch.multinomial(rows, 1, generator=generator).squeeze(-1)
            observation = step[OBSERVATION].view(count, episodes, -1)
            return policies.act(observation, generator=generator).flatten(0, 1)

        with Rollouts(make) as rollouts:
            assert rollouts.table is not None
            return rollouts(act, seeds=seeds, max_steps=max_steps)

    rolled = roll()
    steps = int(rolled[MASK].sum())
    actions = [row["action"][row[MASK]].numpy() for row in rolled.unbind(0)]
    ratio = race(
        f"{count} policies ({acts}) x {episodes} episodes of {make.__name__}, looked up, "
        f"{steps} steps",
        roll,
        lambda: bare([env] * len(seeds), seeds, actions),
        reference="bare env.step",
        target=20,
        rounds=5,
    )
    assert ratio > least
