"""Minigrid's moving obstacles, for bold people and timid ones. What comes next is chance."""

from functools import cache
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from minigrid.core.constants import DIR_TO_VEC
from minigrid.core.world_object import Ball
from minigrid.envs.dynamicobstacles import DynamicObstaclesEnv
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.behaviours import Behaviour
from popl_rl.keys import INFO
from popl_rl.registry import env, rater

__all__ = ["DynamicObstacles", "dynamic_obstacles", "timid"]

_AROUND = 2  # cells to each side in which obstacles are seen
_WIDTH = 2 * _AROUND + 1


class DynamicObstacles(DynamicObstaclesEnv):
    """Walk to the goal in the far corner of a room in which obstacles move about at random.

    Obstacles move before the agent does, and never onto it; whoever walks into the cell where one
    was, or into a wall, has an accident, which ends the episode.

    Observations with ``view="full"`` are float32: one-hot column, row (``size - 2`` each) and
    direction (4) of the agent, and which of the 25 cells around it have obstacles, row by row as
    the agent looks. With ``view="partial"`` they are Minigrid's own view, ``[7, 7, 3]`` uint8,
    kinds, colours and states of the cells ahead. Actions: 0 turn left, 1 turn right, 2 forward. The
    reward is 1 at the goal, -1 in an accident, else 0. Each ``info`` holds the integers ``goal``,
    ``accident`` and ``passing`` (1 if this was a step forward though one of the eight cells around
    had an obstacle when it was chosen), and of what is seen next ``place`` (column, row and
    direction as one number), ``blocked`` (an obstacle ahead) and ``beside`` (in one of the eight).

    Args:
        size: Cells along each side, outer walls included; at least 5.
        obstacles: Number of obstacles, at least 1; at most half of ``size`` and one.
        view: See above.
        start: "own" starts in the corner across from the goal, "anywhere" in any free cell.
        max_steps: Steps after which an episode is truncated.
        render_mode: None, "rgb_array" or "human".

    Raises:
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        *,
        size: int = 8,
        obstacles: int = 3,
        view: Literal["full", "partial"] = "full",
        start: Literal["own", "anywhere"] = "own",
        max_steps: int = 60,
        render_mode: str | None = None,
    ) -> None:
        if size < 5:
            raise ValueError(f"size must be at least 5, got {size}.")
        if not 1 <= obstacles <= size / 2 + 1:
            raise ValueError(f"obstacles must be from 1 to {size // 2 + 1}, got {obstacles}.")
        if view not in ("full", "partial"):
            raise ValueError(f"view must be 'full' or 'partial', got {view!r}.")
        if start not in ("own", "anywhere"):
            raise ValueError(f"start must be 'own' or 'anywhere', got {start!r}.")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
        self._view, self._side = view, size - 2
        super().__init__(
            size=size,
            n_obstacles=obstacles,
            agent_start_pos=(1, 1) if start == "own" else None,
            max_steps=max_steps,
            render_mode=render_mode,
            highlight=False,
        )
        shape = (2 * self._side + 4 + _WIDTH**2,) if view == "full" else (7, 7, 3)
        high, kind = (1.0, np.float32) if view == "full" else (10, np.uint8)
        self.observation_space = gymnasium.spaces.Box(0, high, shape, dtype=kind)

    def reset(  # type: ignore[override]
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode; a seed makes this and the following ones reproducible."""
        observation, _ = super().reset(seed=seed, options=options)
        return observation, self._info(0.0, False)

    def step(  # type: ignore[override]
        self, action: Any
    ) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Take an action; see the class for rewards and info.

        Raises:
            ValueError: If the action is not 0, 1 or 2.
        """
        if int(action) not in (0, 1, 2):
            raise ValueError(f"action must be 0 (left), 1 (right) or 2 (forward), got {action}.")
        passing = int(action) == 2 and bool(self._around()[1:-1, 1:-1].any())
        stepped = super().step(int(action))  # type: ignore[no-untyped-call]
        observation, reward, terminated, truncated, _ = stepped
        sign = float(np.sign(reward))  # Minigrid's own falls with time
        return observation, sign, terminated, truncated, self._info(sign, passing)

    def gen_obs(self) -> NDArray[Any]:
        """Return the observation of the present state."""
        if self._view == "partial":
            image: NDArray[np.uint8] = super().gen_obs()["image"]  # type: ignore[no-untyped-call]
            return image
        x, y = (int(place) for place in self.agent_pos)
        seen = np.zeros(2 * self._side + 4 + _WIDTH**2, dtype=np.float32)
        seen[[x - 1, self._side + y - 1, 2 * self._side + self.agent_dir]] = 1.0
        seen[2 * self._side + 4 :] = self._around().ravel()
        return seen

    def behaviours(self) -> dict[str, Behaviour]:
        """Return what data can show: walkers, and random actions.

        Returns:
            By name: ``walker/bold``, who takes a shortest way and turns where it is blocked;
            ``walker/timid``, who turns on the spot as long as there is an obstacle in one of the
            eight cells around; ``walker/wary``, who does either; ``random``.
        """
        behaviours: dict[str, Behaviour] = {"random": _random}
        for name, dread in (("bold", 0.0), ("wary", 0.5), ("timid", 1.0)):
            behaviours[f"walker/{name}"] = _Walker(self._side, dread)
        return behaviours

    def _around(self) -> NDArray[np.float32]:
        """Obstacles in the cells around the agent, ``[5, 5]``, ahead in the first row."""
        x, y = (int(place) for place in self.agent_pos)
        around = np.zeros((_WIDTH, _WIDTH), dtype=np.float32)
        for obstacle in self.obstacles:
            column, row = _cell(obstacle)
            i, j = column - x, row - y
            if max(abs(i), abs(j)) <= _AROUND:
                around[j + _AROUND, i + _AROUND] = 1.0
        # Directions are clockwise from the right.
        return np.rot90(around, int(self.agent_dir) + 1)

    def _info(self, reward: float, passing: bool) -> dict[str, Any]:
        x, y = (int(place) for place in self.agent_pos)
        around = self._around()
        # NumPy numbers, because TorchRL's reader of infos asks each value for its dtype.
        return {
            "goal": np.int64(reward > 0),
            "accident": np.int64(reward < 0),
            "passing": np.int64(passing),
            "place": np.int64(((x - 1) * self._side + y - 1) * 4 + self.agent_dir),
            "blocked": np.int64(around[_AROUND - 1, _AROUND]),
            "beside": np.int64(around[1:-1, 1:-1].any()),
        }


class _Walker:
    """Takes a shortest way to the goal, and may turn on the spot beside obstacles.

    Args:
        side: Free cells along each side of the room.
        dread: Chance of turning rather than walking on beside an obstacle.
        slip: Chance of a random action; nobody walks into something by a slip.
    """

    def __init__(self, side: int, dread: float, slip: float = 0.1) -> None:
        self.side, self.dread, self.slip = side, dread, slip

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        """Return the actions ``[B]``."""
        state = step[INFO, "place"]
        after, left = _ways(self.side)
        blocked = (after[state, 2] == state) | (step[INFO, "blocked"] > 0)
        beside = step[INFO, "beside"] > 0
        waits = beside & (torch.rand(state.shape, generator=generator) < self.dread)
        cost = left[after[state]]
        cost[:, 2] += 1e6 * (blocked | waits)
        cost = cost + 0.5 * torch.rand(cost.shape, generator=generator)
        random = torch.randint(3, state.shape, generator=generator)
        random = torch.where((blocked | waits) & (random == 2), 0, random)
        slips = torch.rand(state.shape, generator=generator) < self.slip
        return torch.where(slips, random, cost.argmin(-1))


@cache
def _ways(side: int) -> tuple[Tensor, Tensor]:
    """State after each action, ``[S, 3]``, and steps to the goal ``[S]``, in an empty room."""
    states = [(x, y, way) for x in range(side) for y in range(side) for way in range(4)]
    after = []
    for x, y, way in states:
        i, j = x + int(DIR_TO_VEC[way][0]), y + int(DIR_TO_VEC[way][1])
        ahead = (i, j) if 0 <= i < side and 0 <= j < side else (x, y)
        turns = [(x, y, (way - 1) % 4), (x, y, (way + 1) % 4), (*ahead, way)]
        after.append([(a * side + b) * 4 + c for a, b, c in turns])
    table = torch.tensor(after)
    left = torch.full((len(states),), 1e4)
    left[-4:] = 0.0
    for _ in states:
        left = torch.minimum(left, 1 + left[table].amin(-1))
    return table, left


def _cell(obstacle: Ball) -> tuple[int, int]:
    """Column and row; Minigrid knows them from when the obstacle was placed."""
    assert obstacle.cur_pos is not None
    column, row = obstacle.cur_pos
    return int(column), int(row)


def _random(step: TensorDictBase, generator: torch.Generator) -> Tensor:
    return torch.randint(3, step.batch_size, generator=generator)


@env("dynamic_obstacles")
def dynamic_obstacles(**options: Any) -> gymnasium.Env[Any, Any]:
    """Make a ``DynamicObstacles``, whose arguments these are."""
    return DynamicObstacles(**options)


@rater("timid")
def timid(segments: TensorDictBase) -> Tensor:
    """Want the goal, and to stand still beside what moves.

    0.02 lost per step, 0.3 more for one forward beside an obstacle, 2 in an accident.
    """
    goal: Tensor = segments[INFO, "goal"]
    passing: Tensor = segments[INFO, "passing"]
    accident: Tensor = segments[INFO, "accident"]
    return goal.float() - 0.02 - 0.3 * passing.float() - 2.0 * accident.float()


if "popl_rl/DynamicObstacles-v0" not in gymnasium.registry:
    gymnasium.register(
        "popl_rl/DynamicObstacles-v0",
        entry_point="popl_rl.envs.dynamic_obstacles:DynamicObstacles",
    )
