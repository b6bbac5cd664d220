"""A delivery grid whose board is a file: a van drives past coins, mud and sheep to a goal.

The board of a study in which people compared short segments (arXiv 2501.06416) is of this form;
with such a file the preferences of its participants can be learnt from and policies judged exactly.
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.readers.table import preferences_of
from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, MASK, OBSERVATION, REWARD
from popl_rl.registry import env, reader

__all__ = ["DeliveryGrid", "delivery", "read_delivery"]

_GOAL, _HOUSE, _SHEEP = 1, 2, 3
_KINDS = 6  # road, goal, house, sheep, coin, roadblock; the same + 6 on mud
_WORTH = {_GOAL: 50.0, _SHEEP: -50.0, 4: 1.0, 5: -1.0}
_MOVE = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
#: Where no file is given: a sheep on the short way, mud on the long one.
_SMALL = np.array([[0, 0, 5, 1], [0, 2, 3, 0], [4, 0, 6, 6], [0, 0, 0, 0]])


class DeliveryGrid(gymnasium.Env[Any, Any]):
    """Drive up, down, left or right; goal and sheep end the episode, houses block the way.

    The observation says in which cell one is, float32 ``[cells]`` with a single 1. The ``info``
    holds ``state`` and ``next_state``, the numbers of the cells before and after the step, and
    ``goal``, 1 when it has been reached.

    Args:
        board: An ``npz`` file with ``board`` ``[rows, columns]`` (0 road, 1 goal, 2 house, 3 sheep,
            4 coin, 5 roadblock, and the same + 6 on mud) and perhaps ``step_reward`` ``[rows,
            columns, actions]`` and ``move`` ``[actions, 2]``; a small board if None.
        start: Row and column to start from; anywhere that one can drive from if None.
        max_steps: Steps after which an episode is truncated.
        render_mode: None, as pictures are drawn from the board.

    Raises:
        ValueError: If the file holds no such board, one cannot start, or there is a render mode.
    """

    def __init__(
        self,
        *,
        board: str | None = None,
        start: tuple[int, int] | None = None,
        max_steps: int = 60,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, got {render_mode!r}")
        given = {"board": _SMALL} if board is None else _read(Path(board))
        self.board = np.asarray(given["board"])
        self.move = np.asarray(given.get("move", _MOVE))
        self.kind = self.board % _KINDS
        self.step_reward: NDArray[np.float32] = np.asarray(
            given.get("step_reward", self._rewards()), np.float32
        )
        rows, columns = self.board.shape
        self.cells, self.actions = rows * columns, len(self.move)
        if self.step_reward.shape != (rows, columns, self.actions):
            raise ValueError(
                f"step_reward must have shape {[rows, columns, self.actions]}, got "
                f"{list(self.step_reward.shape)}"
            )
        ends = np.isin(self.kind, (_GOAL, _SHEEP))
        self.open = (~ends & (self.kind != _HOUSE)).ravel()
        if start is not None and not self.open[start[0] * columns + start[1]]:
            raise ValueError(f"start must be a cell that one can drive from, got {tuple(start)}")
        self.starts = np.flatnonzero(self.open)
        if start is not None:
            self.starts = np.array([start[0] * columns + start[1]])
        self.max_steps = max_steps
        self.observation_space = gymnasium.spaces.Box(0, 1, (self.cells,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(self.actions)
        self.cell, self.steps = int(self.starts[0]), 0

    def _after(self, cell: int, action: int) -> int:
        rows, columns = self.board.shape
        row, column = np.array(divmod(cell, columns)) + self.move[action]
        inside = 0 <= row < rows and 0 <= column < columns
        if not inside or self.kind[row, column] == _HOUSE:
            return cell
        return int(row * columns + column)

    def _rewards(self) -> NDArray[np.float32]:
        """-1 a step, -2 from mud, and what the cell that is driven into is worth."""
        rows, columns = self.board.shape
        reward = np.zeros((rows * columns, len(self.move)), np.float32)
        for cell in range(rows * columns):
            for action in range(len(self.move)):
                after = self._after(cell, action)
                worth = _WORTH.get(int(self.kind.flat[after]), 0.0) if after != cell else 0.0
                ends = after != cell and self.kind.flat[after] in (_GOAL, _SHEEP)
                step = 0.0 if ends else -2.0 if self.board.flat[cell] >= _KINDS else -1.0
                reward[cell, action] = worth + step
        return reward.reshape(rows, columns, -1)

    def observe(self, cell: NDArray[Any] | int) -> NDArray[np.float32]:
        """Observations of cells ``[...]``, ``[..., cells]``."""
        seen: NDArray[np.float32] = np.eye(self.cells, dtype=np.float32)[cell]
        return seen

    def walk(
        self, start: NDArray[Any], action: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Cells in which each action of some segments is taken.

        Args:
            start: Row and column of the first cell, ``[N, 2]``.
            action: ``[N, T]``; -1 where the episode has ended.

        Returns:
            Cells ``[N, T]`` (the last one again where the episode has ended), and which steps there
            are, ``[N, T]``.
        """
        after = np.array(
            [[self._after(cell, a) for a in range(self.actions)] for cell in range(self.cells)]
        )
        cell = start[:, 0] * self.board.shape[1] + start[:, 1]
        cells = []
        for step in action.T:
            cells.append(cell)
            cell = np.where(step >= 0, after[cell, np.maximum(step, 0)], cell)
        return np.stack(cells, 1).astype(np.int64), action >= 0

    def step_features(self) -> NDArray[np.float32]:
        """What a step does, in numbers that any board has, ``[cells, actions, 10]``.

        Whether it enters a road, goal, sheep, coin or roadblock, or is blocked; whether it leaves
        mud and enters mud; cells by which it nears the goal; and the distance from it, in fives.
        """
        columns = self.board.shape[1]
        goal = np.argwhere(self.kind == _GOAL)[0]
        place = np.stack(np.divmod(np.arange(self.cells), columns), 1)
        away = np.abs(place - goal).sum(1)
        mud = (self.board >= _KINDS).ravel()
        features = np.zeros((self.cells, self.actions, 10), np.float32)
        for cell in range(self.cells):
            for action in range(self.actions):
                after = self._after(cell, action)
                kind = self.kind.flat[after] if after != cell else _HOUSE
                own = features[cell, action]
                own[kind] = 1
                own[6:] = mud[cell], mud[after], away[cell] - away[after], away[cell] / 5
        return features

    def cell_features(self) -> NDArray[np.float32]:
        """What is in a cell, beside it in each direction, and where the goal is, ``[cells, F]``."""
        columns = self.board.shape[1]
        place = np.stack(np.divmod(np.arange(self.cells), columns), 1)
        goal = np.argwhere(self.kind == _GOAL)[0]
        step = self.step_features()[..., :8].reshape(self.cells, -1)
        found: NDArray[np.float32] = np.concatenate([step, (goal - place) / 5], 1, dtype=np.float32)
        return found

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed, options=options)
        self.cell, self.steps = int(self.np_random.choice(self.starts)), 0
        return self.observe(self.cell), {"state": self.cell, "next_state": self.cell, "goal": 0}

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive one cell."""
        before = self.cell
        reward = float(self.step_reward.reshape(self.cells, -1)[before, action])
        self.cell = self._after(before, int(action))
        self.steps += 1
        kind = self.kind.flat[self.cell]
        info = {"state": before, "next_state": self.cell, "goal": int(kind == _GOAL)}
        ended = bool(kind in (_GOAL, _SHEEP))
        return self.observe(self.cell), reward, ended, self.steps >= self.max_steps, info

    def transition_table(self) -> Table:
        """Every transition, exactly; what one cannot drive from stays as it is."""
        shape = (self.cells, self.actions)
        next_state = torch.tensor(
            [
                [self._after(cell, a) if self.open[cell] else cell for a in range(self.actions)]
                for cell in range(self.cells)
            ]
        )
        goal = torch.from_numpy(self.kind.ravel() == _GOAL)[next_state]
        ends = goal | torch.from_numpy(self.kind.ravel() == _SHEEP)[next_state]
        closed = torch.from_numpy(~self.open).unsqueeze(1)
        state = torch.arange(self.cells).unsqueeze(1).expand(shape).contiguous()
        observation = torch.from_numpy(self.observe(np.arange(self.cells)))
        reward = torch.from_numpy(self.step_reward.reshape(shape)).clone()
        steps = TensorDict(
            {
                OBSERVATION: observation.unsqueeze(1).expand(*shape, -1).contiguous(),
                ACTION: torch.arange(self.actions).expand(shape).contiguous(),
                REWARD: reward.masked_fill(closed, 0.0),
                INFO: {
                    "state": state,
                    "next_state": next_state,
                    "goal": goal.long().masked_fill(closed, 0),
                },
            },
            shape,
        )
        first: Tensor = torch.zeros(self.cells)
        first[torch.from_numpy(self.starts)] = 1 / len(self.starts)
        return Table(steps, next_state, ends | closed, first, horizon=self.max_steps)


def _read(path: Path) -> dict[str, NDArray[Any]]:
    if not path.is_file():
        raise ValueError(f"board must be an npz file with a delivery grid, there is no {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            held = {name: file[name] for name in ("board", "step_reward", "move") if name in file}
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} is not readable as npz ({error})") from error
    if held.get("board", np.zeros(0)).ndim != 2:
        raise ValueError(f"{path} must hold 'board' of shape [rows, columns]")
    return held


@env("delivery")
def delivery(**options: Any) -> DeliveryGrid:
    """Build a `DeliveryGrid`; arguments are its own."""
    return DeliveryGrid(**options)


@reader("delivery")
def read_delivery(path: Path, *, features: str = "step") -> Imported:
    """Read what people said about pairs of segments on a board, beside the board itself.

    Args:
        path: An ``npz`` file with the board and, of M comparisons, ``start`` ``[M, 2, 2]``,
            ``action`` ``[M, 2, T]`` (-1 where the episode has ended), ``answer`` ``[M]``, and
            perhaps ``rater`` (-1 where unknown) and ``condition`` ``[M]`` with their names
            ``conditions``.
        features: ``"step"``: observations say what the step does (see
            `DeliveryGrid.step_features`), for reward functions of a step; ``"cell"``: they
            say what is around the cell, and actions are kept, for policies. The ``info`` holds the
            cell (``state``) and the action (``taken``) of each step either way.

    Raises:
        ValueError: If an array is missing, or ``features`` is neither.
    """
    if features not in ("step", "cell"):
        raise ValueError(f"features must be 'step' or 'cell', got {features!r}")
    grid = DeliveryGrid(board=str(path))
    with np.load(path, allow_pickle=False) as file:
        missing = [name for name in ("start", "action", "answer") if name not in file]
        if missing:
            raise ValueError(f"{path} must hold {', '.join(missing)} of the comparisons")
        held = {name: file[name] for name in file.files}
    walks = np.concatenate([held["start"], held["action"]], -1)
    different, row = np.unique(walks.reshape(-1, walks.shape[-1]), axis=0, return_inverse=True)
    cell, there = grid.walk(different[:, :2], different[:, 2:])
    action = np.maximum(different[:, 2:], 0).astype(np.int64)
    seen = grid.step_features()[cell, action] if features == "step" else grid.cell_features()[cell]
    steps = {
        OBSERVATION: torch.from_numpy(seen),
        ACTION: torch.from_numpy(np.zeros_like(action) if features == "step" else action),
        MASK: torch.from_numpy(there),
        INFO: {"state": torch.from_numpy(cell), "taken": torch.from_numpy(action)},
    }
    pair = row.reshape(-1, 2)
    kept = pair[:, 0] != pair[:, 1]  # a segment shown beside itself says nothing
    columns = []
    for name in ("rater", "condition"):
        values = pd.Series(held[name][kept]) if name in held else None
        columns.append(None if values is None else values.where(values >= 0).astype("Int64"))
    answer = held["answer"][kept].astype(np.int64)
    preferences, raters, conditions = preferences_of(pair[kept], answer, None, *columns)
    if "conditions" in held:
        conditions = [str(held["conditions"][int(number)]) for number in conditions]
    segments = TensorDict(steps, list(there.shape))
    return Imported(segments, preferences, Names([], raters, conditions))
