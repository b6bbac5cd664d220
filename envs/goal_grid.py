"""An open grid in which every group of raters wants to be in a cell of its own.

Made for many groups: up to sixteen, who agree on nothing but that walls lead nowhere. All
transitions are listed in a table, which gives exact advantages and returns.
"""

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.tables import Table
from popl_rl.envs.explorer import Explorer
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.registry import env, rater

__all__ = ["GoalGrid", "goal_grid", "visits"]

_MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1), (0, 0))
_MOST = 16  # goals


class GoalGrid(gymnasium.Env[Any, Any]):
    """Walk about; nothing is rewarded, and episodes end by ``max_steps`` alone.

    Goals are evenly spaced along the outermost cells, goal 0 in the top left corner and the others
    following clockwise. Episodes start in a uniformly random cell.

    Observations are float32: one-hot column and row (``size`` each). Actions: 0 right, 1 down, 2
    left, 3 up, 4 stay; a move into the outer wall leaves one where one is. Each ``info`` holds the
    integers ``state`` (index of the cell before the step; at reset the current one),
    ``next_state`` and ``reached``, the goal whose cell the step ends in, or -1.

    Args:
        size: Cells along each side, at least 3.
        goals: Number of goals, 1 to 16, and at most the number of outermost cells.
        max_steps: Steps after which an episode is truncated.
        render_mode: None or "rgb_array".

    Attributes:
        goal_states: State of each goal.
        cells: ``[S, 2]`` int64, column and row of every state.

    Raises:
        ValueError: If an argument is out of its range.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}

    def __init__(
        self,
        *,
        size: int = 7,
        goals: int = 12,
        max_steps: int = 30,
        render_mode: str | None = None,
    ) -> None:
        if size < 3:
            raise ValueError(f"size must be at least 3, got {size}.")
        ring = _outermost(size)
        if not 1 <= goals <= min(_MOST, len(ring)):
            most = min(_MOST, len(ring))
            raise ValueError(f"goals must be from 1 to {most} with size={size}, got {goals}.")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        self.size, self.max_steps, self.render_mode = size, max_steps, render_mode
        chosen = [ring[len(ring) * goal // goals] for goal in range(goals)]
        self.goal_states = [row * size + column for column, row in chosen]
        index = torch.arange(size * size)
        self.cells = torch.stack([index % size, index // size], 1)
        self.action_space = gymnasium.spaces.Discrete(len(_MOVES))
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (2 * size,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes this and the following ones reproducible."""
        super().reset(seed=seed, options=options)
        self._time = 0
        self._state = int(self.np_random.integers(self.size**2))
        return self._observation(self._state), self._info(self._state)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take an action; see the class for what it does.

        Raises:
            ValueError: If there is no such action.
        """
        if int(action) not in range(len(_MOVES)):
            raise ValueError(f"action must be from 0 to {len(_MOVES) - 1}, got {action}.")
        before = self._state
        self._state = self._after(before, int(action))
        self._time += 1
        info = self._info(before)
        return self._observation(self._state), 0.0, False, self._time >= self.max_steps, info

    def transition_table(self) -> Table:
        """Return every transition of this environment, exactly."""
        states, actions = self.size**2, len(_MOVES)
        shape = (states, actions)
        after = [
            [self._after(state, action) for action in range(actions)] for state in range(states)
        ]
        next_state = torch.tensor(after)
        observation = torch.from_numpy(np.stack([self._observation(s) for s in range(states)]))
        steps = TensorDict(
            {
                OBSERVATION: observation.unsqueeze(1).expand(*shape, -1).contiguous(),
                ACTION: torch.arange(actions).expand(shape).contiguous(),
                REWARD: torch.zeros(shape),
                INFO: {
                    "state": torch.arange(states).unsqueeze(1).expand(shape).contiguous(),
                    "next_state": next_state,
                    "reached": torch.tensor([self._reached(s) for s in range(states)])[next_state],
                },
            },
            batch_size=shape,
        )
        terminal = torch.zeros(shape, dtype=torch.bool)
        start = torch.full((states,), 1 / states)
        return Table(steps, next_state, terminal, start, horizon=self.max_steps)

    def behaviours(self) -> dict[str, Tensor | Explorer]:
        """Return what data can show: an explorer and random actions, no one's own wish."""
        table = self.transition_table()
        uniform = torch.full(table.next_state.shape, 1 / len(_MOVES))
        return {"explorer": Explorer(table, self.cells), "random": uniform}

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw the grid as pixels ``[H, W, 3]``: goals from red to violet, the walker in black."""
        if self.render_mode is None:
            return None
        picture = np.full((self.size, self.size, 3), 255, dtype=np.uint8)
        for goal, state in enumerate(self.goal_states):
            picture[divmod(state, self.size)] = _colour(goal / len(self.goal_states))
        picture = picture.repeat(24, 0).repeat(24, 1)
        row, column = (24 * place for place in divmod(self._state, self.size))
        picture[row + 6 : row + 18, column + 6 : column + 18] = 0
        return picture

    def _after(self, state: int, action: int) -> int:
        row, column = divmod(state, self.size)
        right, down = _MOVES[action]
        end = self.size - 1
        return min(max(row + down, 0), end) * self.size + min(max(column + right, 0), end)

    def _observation(self, state: int) -> NDArray[np.float32]:
        row, column = divmod(state, self.size)
        observation = np.zeros(2 * self.size, dtype=np.float32)
        observation[[column, self.size + row]] = 1.0
        return observation

    def _reached(self, state: int) -> int:
        return self.goal_states.index(state) if state in self.goal_states else -1

    def _info(self, before: int) -> dict[str, Any]:
        # NumPy numbers, because TorchRL's reader of infos asks each value for its dtype.
        return {
            "state": np.int64(before),
            "next_state": np.int64(self._state),
            "reached": np.int64(self._reached(self._state)),
        }


@env("goal_grid")
def goal_grid(
    *, size: int = 7, goals: int = 12, max_steps: int = 30, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    """Make a `GoalGrid`, whose arguments these are."""
    return GoalGrid(size=size, goals=goals, max_steps=max_steps, render_mode=render_mode)


@rater("visits")
def visits(segments: TensorDictBase, goal: int) -> Tensor:
    """Want to be in the cell of one goal, as many steps as possible.

    Args:
        segments: Segments ``[B, T]`` of `GoalGrid`.
        goal: Number of the goal, from 0.
    """
    reached: Tensor = segments[INFO, "reached"]
    return (reached == goal).float()


def _outermost(size: int) -> list[tuple[int, int]]:
    """Outermost cells ``(column, row)``, clockwise from the top left corner."""
    end = size - 1
    top = [(column, 0) for column in range(end)]
    right = [(end, row) for row in range(end)]
    bottom = [(column, end) for column in range(end, 0, -1)]
    left = [(0, row) for row in range(end, 0, -1)]
    return [*top, *right, *bottom, *left]


def _colour(hue: float) -> list[int]:
    """A saturated colour of a hue in [0, 1)."""
    from colorsys import hsv_to_rgb

    return [round(255 * part) for part in hsv_to_rgb(0.8 * hue, 0.7, 0.95)]


if "popl_rl/GoalGrid-v0" not in gymnasium.registry:
    gymnasium.register("popl_rl/GoalGrid-v0", entry_point="popl_rl.envs.goal_grid:GoalGrid")
