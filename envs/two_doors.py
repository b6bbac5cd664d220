"""A grid world with a goal behind a wall, and rater groups who each want another door used.

Everybody wants the goal soon, so people agree on most of the task and differ only in the door. All
transitions are listed in a table, which gives exact advantages, behaviours and returns.
"""

import itertools
from collections.abc import Callable
from functools import cache
from typing import Any, Literal, TypeAlias

import gymnasium
import numpy as np
import torch
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Floor, Goal
from minigrid.minigrid_env import MiniGridEnv
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.tables import Table, solve
from popl_rl.envs.explorer import Explorer
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.raters.groups import Utility
from popl_rl.registry import env, rater

__all__ = ["TwoDoors", "fourth", "lower", "third", "two_doors", "upper"]

_DOOR_NAMES = ("upper", "lower", "third", "fourth")
_DOOR_COLOURS = ("red", "blue", "yellow", "purple")
_FORWARD = 2
_STEP_COST = 0.02
_MIN_SIZE = 7
_State: TypeAlias = tuple[int, int, int]  # x, y, direction


class TwoDoors(MiniGridEnv):
    """Reach the goal on the far side of a wall, through one of its doors.

    The grid has outer walls and an inner wall at column ``size // 2``. The goal is at column
    ``size - 2``, row ``size // 2``. Doors are gaps, drawn as coloured floor: the wall's
    ``size - 2`` rows are cut into as many equal bands as there are doors, with a door at the middle
    row of each. Door 0 is the topmost ("upper", red), 1 the bottommost ("lower", blue), 2 the next
    from the top ("third", yellow), 3 the one after ("fourth", purple). Odd sizes are symmetric
    about the goal's row.

    Observations are float32: one-hot column, row (``size - 2`` each) and direction (4), so the
    state is fully seen. Actions: 0 turn left, 1 turn right, 2 forward. The reward is 1 on reaching
    the goal and -0.02 on any other step. Each ``info`` holds the integers ``state`` (index of the
    state before the step; at reset the current one), ``next_state``, ``door`` (the door walked into
    from the near side by this step, else -1) and ``goal`` (1 if this step reached the goal).

    Args:
        size: Cells along each side, outer walls included; at least 7.
        doors: Number of doors, 2 to 4.
        start: "near" starts in a uniformly random cell and direction left of the wall; "anywhere"
            in any free cell but the goal; "mixed" does either with equal chance.
        max_steps: Steps after which an episode is truncated.
        render_mode: None, "rgb_array" or "human".

    Attributes:
        states: ``(x, y, direction)`` of every state, the goal's included. Nobody acts at the goal,
            where an episode is over; the table lists what would happen.
        cells: ``[S, 2]`` int64, column and row of every state, for maps of occupancy.
        near_cells: Free cells left of the wall, as ``(x, y)``.
        door_cells: Cell of each door, in the order of door indices.
        goal_cell: Cell of the goal.

    Raises:
        ValueError: If an argument is out of its range or the doors do not fit into the wall.
    """

    def __init__(
        self,
        *,
        size: int = 9,
        doors: int = 2,
        start: Literal["near", "anywhere", "mixed"] = "near",
        max_steps: int = 60,
        render_mode: str | None = None,
    ) -> None:
        rows = _checked_door_rows(size, doors)
        if start not in ("near", "anywhere", "mixed"):
            raise ValueError(f"start must be 'near', 'anywhere' or 'mixed', got {start!r}.")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
        super().__init__(
            mission_space=MissionSpace(mission_func=_mission),
            grid_size=size,
            max_steps=max_steps,
            see_through_walls=True,
            render_mode=render_mode,
            highlight=False,  # the observation is the whole state, so no field of view is drawn
        )
        self.size = size
        self.start = start
        self.wall = size // 2
        self.goal_cell = (size - 2, size // 2)
        # So that "upper" and "lower" are the topmost and bottommost with any number of doors.
        self.door_cells = [(self.wall, row) for row in (rows[0], rows[-1], *rows[1:-1])]
        inside = range(1, size - 1)
        free = [
            (x, y) for y in inside for x in inside if x != self.wall or (x, y) in self.door_cells
        ]
        self.near_cells = [cell for cell in free if cell[0] < self.wall]
        self.states = [(x, y, direction) for x, y in free for direction in range(4)]
        self.cells = torch.tensor([state[:2] for state in self.states])
        self._index = {state: index for index, state in enumerate(self.states)}
        self._laid_out: Grid | None = None
        near = [s for s in self.states if s[:2] in self.near_cells]
        anywhere = [s for s in self.states if s[:2] != self.goal_cell]
        # Entries may repeat: a start is a uniform draw from this list.
        self._first = {
            "near": near,
            "anywhere": anywhere,
            "mixed": near * len(anywhere) + anywhere * len(near),
        }[start]
        self.action_space = gymnasium.spaces.Discrete(3)
        self.observation_space = gymnasium.spaces.Box(
            0.0, 1.0, (2 * (size - 2) + 4,), dtype=np.float32
        )

    def state_index(self, x: int, y: int, direction: int) -> int:
        """Return the index of a state in ``states``; KeyError if the cell is not free."""
        return self._index[int(x), int(y), int(direction)]

    def cell_of(self, state: int) -> tuple[int, int]:
        """Return the column and row of a state; ``cells`` has them all at once."""
        x, y, _ = self.states[state]
        return x, y

    def reset(  # type: ignore[override]
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes this and the following ones reproducible."""
        observation, _ = super().reset(seed=seed, options=options)
        state = self.state_index(*self._state())
        return observation, _info(state, state, -1, False)

    def step(  # type: ignore[override]
        self, action: Any
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take an action; see the class for rewards and info.

        Raises:
            ValueError: If the action is not 0, 1 or 2.
        """
        # Minigrid has four more actions, which the action space leaves out.
        if int(action) not in (0, 1, 2):
            raise ValueError(f"action must be 0 (left), 1 (right) or 2 (forward), got {action}.")
        before = self._state()
        observation, _, terminated, truncated, _ = super().step(int(action))
        after = self._state()
        door = self._door(before, after)
        info = _info(self.state_index(*before), self.state_index(*after), door, terminated)
        return observation, _reward_of(terminated), terminated, truncated, info

    def gen_obs(self) -> NDArray[np.float32]:
        """Return the observation of the present state, in place of Minigrid's partial view."""
        return self._observation(*self._state())

    def render_segment(self, segment: TensorDictBase) -> list[NDArray[np.uint8]]:
        """Return the pictures of a segment ``[T]``: before its first step, and after each."""
        self.reset(seed=0)
        frames = []
        for state in [int(segment[INFO, "state"][0]), *segment[INFO, "next_state"].tolist()]:
            x, y, self.agent_dir = self.states[state]
            self.agent_pos = (x, y)
            frames.append(self.get_frame(highlight=False, tile_size=24))
        return frames

    def transition_table(self) -> Table:
        """Return every transition of this environment, exactly."""
        num_states = len(self.states)
        shape = (num_states, 3)
        found = _outcomes(self.size, len(self.door_cells))
        next_state, door, goal = (column.clone() for column in found)
        observation = torch.from_numpy(np.stack([self._observation(*s) for s in self.states]))
        state_of = torch.arange(num_states).unsqueeze(1).expand(shape)
        steps = TensorDict(
            {
                OBSERVATION: observation.unsqueeze(1).expand(*shape, -1).contiguous(),
                ACTION: torch.arange(3).expand(shape).contiguous(),
                REWARD: torch.where(goal, _reward_of(True), _reward_of(False)),
                INFO: {
                    "state": state_of.contiguous(),
                    "next_state": next_state,
                    "door": door,
                    "goal": goal.long(),
                },
            },
            batch_size=shape,
        )
        first = torch.tensor([self._index[state] for state in self._first])
        start = first.bincount(minlength=num_states) / len(first)
        return Table(steps, next_state, goal, start, horizon=self.max_steps)

    def behaviours(self) -> dict[str, Tensor | Explorer]:
        """Return what data can show: planners, an explorer and random actions.

        Returns:
            By name: ``planner/<group>/<temperature>``, tables ``[S, A]`` of action probabilities,
            softmax(advantage / temperature) of the group's optimal advantages; ``explorer``;
            ``random``, the uniform table.
        """
        table = self.transition_table()
        behaviours: dict[str, Tensor | Explorer] = {}
        for name, _ in zip(_DOOR_NAMES, self.door_cells, strict=False):
            advantages, _values = solve(table, _GROUPS[name](table.steps))
            for temperature in (0.03, 0.1, 0.3):
                probabilities = (advantages / temperature).softmax(-1)
                behaviours[f"planner/{name}/{temperature}"] = probabilities
        behaviours["explorer"] = Explorer(table, self.cells)
        behaviours["random"] = torch.full(table.next_state.shape, 1 / 3)
        return behaviours

    def _state(self) -> _State:
        x, y = self.agent_pos
        return int(x), int(y), int(self.agent_dir)

    def outcome(self, state: int, action: int) -> tuple[int, int, bool]:
        """Return the next state, the door that is gone through or -1, and whether the goal is."""
        before = self.states[state]
        after = self._move(before, action)
        goal = self.goal_cell == after[:2] != before[:2]
        return self._index[after], self._door(before, after), goal

    def _gen_grid(self, width: int, height: int) -> None:
        if self._laid_out is None:
            self._laid_out = self._lay_out(width, height)
        self.grid = self._laid_out  # which no action changes
        x, y, direction = self._first[int(self.np_random.integers(len(self._first)))]
        self.agent_pos, self.agent_dir = (x, y), direction

    def _lay_out(self, width: int, height: int) -> Grid:
        grid = Grid(width, height)
        grid.wall_rect(0, 0, width, height)
        grid.vert_wall(self.wall, 0)
        for cell, colour in zip(self.door_cells, _DOOR_COLOURS, strict=False):
            grid.set(*cell, Floor(colour))
        grid.set(*self.goal_cell, Goal())
        return grid

    def _observation(self, x: int, y: int, direction: int) -> NDArray[np.float32]:
        side = self.size - 2
        observation = np.zeros(2 * side + 4, dtype=np.float32)
        observation[[x - 1, side + y - 1, 2 * side + direction]] = 1.0
        return observation

    def _move(self, state: _State, action: int) -> _State:
        x, y, direction = state
        if action != _FORWARD:
            return x, y, (direction + (1 if action else -1)) % 4
        dx, dy = ((1, 0), (0, 1), (-1, 0), (0, -1))[direction]
        ahead = (x + dx, y + dy, direction)
        return ahead if ahead in self._index else state

    def _door(self, before: _State, after: _State) -> int:
        if before[0] < self.wall and after[0] == self.wall:
            return self.door_cells.index(after[:2])
        return -1


@cache
def _outcomes(size: int, doors: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return next state, door and goal of every state and action, ``[S, 3]`` each.

    Evaluation asks for a table dozens of times.
    """
    world = TwoDoors(size=size, doors=doors)
    rows = [[world.outcome(s, action) for action in range(3)] for s in range(len(world.states))]
    columns = torch.tensor(rows)
    return columns[..., 0], columns[..., 1], columns[..., 2].bool()


@env("two_doors")
def two_doors(
    *,
    size: int = 9,
    doors: int = 2,
    start: Literal["near", "anywhere", "mixed"] = "near",
    max_steps: int = 60,
    render_mode: str | None = None,
) -> gymnasium.Env[Any, Any]:
    """Make a ``TwoDoors``, whose arguments these are."""
    return TwoDoors(
        size=size, doors=doors, start=start, max_steps=max_steps, render_mode=render_mode
    )


@rater("upper")
def upper(segments: TensorDictBase) -> Tensor:
    """Want the goal soon, through the topmost door."""
    return _through(segments, 0)


@rater("lower")
def lower(segments: TensorDictBase) -> Tensor:
    """Want the goal soon, through the bottommost door."""
    return _through(segments, 1)


def _needs_doors(count: int) -> Callable[[Utility], Utility]:
    """Let a rater say, before anything is done, that an environment lacks the door it wants."""

    def fits(env: Any) -> str | None:
        doors = len(getattr(env, "door_cells", range(count)))
        few = f"their door is one of {count} or more, and there are {doors}; set"
        return None if doors >= count else f"{few} env.options.doors={count}"

    def mark(function: Utility) -> Utility:
        setattr(function, "fits", fits)  # noqa: B010 - the type of a function has none
        return function

    return mark


@rater("third")
@_needs_doors(3)
def third(segments: TensorDictBase) -> Tensor:
    """Want the goal soon, through the second door from the top of three or four."""
    return _through(segments, 2)


@rater("fourth")
@_needs_doors(4)
def fourth(segments: TensorDictBase) -> Tensor:
    """Want the goal soon, through the third door from the top of four."""
    return _through(segments, 3)


_GROUPS = {"upper": upper, "lower": lower, "third": third, "fourth": fourth}


def _through(segments: TensorDictBase, own: int) -> Tensor:
    """Return -0.02 per step, 1 more at the goal, 2 less at another's door, ``[B, T]``."""
    door: Tensor = segments[INFO, "door"]
    another = (door >= 0) & (door != own)
    goal: Tensor = segments[INFO, "goal"]
    return goal.float() - _STEP_COST - 2.0 * another.float()


def _reward_of(goal: bool) -> float:
    return 1.0 if goal else -_STEP_COST


def _info(state: int, next_state: int, door: int, goal: bool) -> dict[str, Any]:
    # NumPy numbers, because TorchRL's reader of infos asks each value for its dtype.
    return {
        "state": np.int64(state),
        "next_state": np.int64(next_state),
        "door": np.int64(door),
        "goal": np.int64(goal),
    }


def _mission() -> str:
    return "reach the goal"


def _door_rows(size: int, doors: int) -> list[int]:
    """Return the middle rows of equal bands of the wall, from the top."""
    band = (size - 2) / doors
    return [int(1 + band * (index + 0.5)) for index in range(doors)]


def _fits(size: int, doors: int) -> bool:
    rows = _door_rows(size, doors)
    return size >= _MIN_SIZE and all(
        after - before >= 2 for before, after in itertools.pairwise(rows)
    )


def _checked_door_rows(size: int, doors: int) -> list[int]:
    if doors not in range(2, len(_DOOR_NAMES) + 1):
        raise ValueError(f"doors must be 2, 3 or 4, got {doors}.")
    if not _fits(size, doors):
        nearest = next(s for s in itertools.count(max(size, _MIN_SIZE)) if _fits(s, doors))
        raise ValueError(
            f"size={size} is too small for {doors} doors with wall between them; the nearest size "
            f"that fits is {nearest}."
        )
    return _door_rows(size, doors)


if "popl_rl/TwoDoors-v0" not in gymnasium.registry:
    gymnasium.register("popl_rl/TwoDoors-v0", entry_point="popl_rl.envs.two_doors:TwoDoors")
