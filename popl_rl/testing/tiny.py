"""A tiny environment to try things on, with two groups of raters."""

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD

__all__ = ["likes_left", "likes_right", "tiny_env"]


class _Walk(gymnasium.Env[Any, Any]):
    """A line of five cells; see ``tiny_env``."""

    _CELLS = 5

    def __init__(self, max_steps: int) -> None:
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (self._CELLS,), dtype=np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)
        self._max_steps = max_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._cell, self._time = int(self.np_random.integers(self._CELLS)), 0
        return self._observation(), {"state": self._cell, "next_state": self._cell}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        before = self._cell
        self._cell = self._after(before, int(action))
        self._time += 1
        info = {"state": before, "next_state": self._cell}
        return self._observation(), 0.0, False, self._time >= self._max_steps, info

    def transition_table(self) -> Table:
        state = torch.arange(self._CELLS).unsqueeze(1).repeat(1, 2)
        action = torch.arange(2).repeat(self._CELLS, 1)
        after = [[self._after(cell, move) for move in range(2)] for cell in range(self._CELLS)]
        next_state = torch.tensor(after)
        steps = TensorDict(
            {
                OBSERVATION: torch.eye(self._CELLS)[state],
                ACTION: action,
                REWARD: torch.zeros(state.shape),
                INFO: {"state": state, "next_state": next_state},
            },
            batch_size=state.shape,
        )
        start = torch.full((self._CELLS,), 1 / self._CELLS)
        terminal = torch.zeros(state.shape, dtype=torch.bool)
        return Table(steps, next_state, terminal, start, horizon=self._max_steps)

    def _after(self, cell: int, action: int) -> int:
        return min(max(cell + (1 if action else -1), 0), self._CELLS - 1)

    def _observation(self) -> NDArray[np.float32]:
        observation: NDArray[np.float32] = np.eye(self._CELLS, dtype=np.float32)[self._cell]
        return observation


def tiny_env(*, max_steps: int = 20) -> gymnasium.Env[Any, Any]:
    """Make a line of five cells to walk on, left (action 0) or right (action 1).

    Episodes start in any cell and never end but by ``max_steps``; the reward is 0. Observations are
    the cell, one-hot ``[5]``; ``info`` holds ``state`` and ``next_state``, and
    ``transition_table()`` lists all steps.
    """
    return _Walk(max_steps)


def likes_left(segments: TensorDictBase) -> Tensor:
    """Want to be on the left of ``tiny_env``: 1 at the left end, down to 0 at the right."""
    return 1 - likes_right(segments)


def likes_right(segments: TensorDictBase) -> Tensor:
    """Want to be on the right of ``tiny_env``: 0 at the left end, up to 1 at the right."""
    cell: Tensor = segments[INFO, "next_state"]
    return cell.float() / (_Walk._CELLS - 1)
