"""Where hypotheses drive on a delivery grid."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from popl_rl.plotting.style import PALETTE, headline

__all__ = ["delivery_walks"]

_SIGNS = {1: "G", 2: "■", 3: "S", 4: "+1", 5: "−1"}
_STEPS = 60


def delivery_walks(grid: Any, policies: Mapping[str, Any]) -> Figure:
    """A board for each policy, with an arrow for what is done in each cell.

    Arrows are coloured by where the way from their cell ends: at the goal, at a sheep, or nowhere.

    Args:
        grid: The delivery grid, see ``envs/delivery.py``.
        policies: Action in each cell, ``[S]``, by name.

    Raises:
        ValueError: If there are no policies.
    """
    if not policies:
        raise ValueError("policies must hold one or more to draw, got none")
    fig = Figure(figsize=(3.3 * len(policies) + 0.2, 4.3))
    headline(
        fig,
        "Where does one drive?",
        "Blue: the way ends at the goal (G). Red: at a sheep (S). Grey: it never ends. "
        "Brown cells are mud.",
    )
    axes = fig.subplots(1, len(policies), squeeze=False)[0]
    for ax, (name, action) in zip(axes, policies.items(), strict=True):
        _board(ax, grid)
        _arrows(ax, grid, np.asarray(action))
        ax.set_title(name, fontsize=10)
    return fig


def _board(ax: Any, grid: Any) -> None:
    mud = grid.board >= 6
    ax.imshow(mud, cmap=ListedColormap(["white", "#e8d9c0"]), vmin=0, vmax=1)
    rows, columns = grid.board.shape
    for row in range(rows):
        for column in range(columns):
            sign = _SIGNS.get(int(grid.kind[row, column]))
            if sign is not None:
                light = sign in ("+1", "−1")
                colour = PALETTE["grey"] if light else "black"
                size = 6 if light else 10
                place = (column - 0.3, row - 0.3) if light else (column, row)
                ax.text(*place, sign, ha="center", va="center", fontsize=size, color=colour)
    ax.set_xticks(np.arange(columns) - 0.5, [])
    ax.set_yticks(np.arange(rows) - 0.5, [])
    ax.grid(color="#dddddd", linewidth=0.5)
    ax.tick_params(length=0)


def _arrows(ax: Any, grid: Any, action: NDArray[np.int64]) -> None:
    table = grid.transition_table()
    after = table.next_state.numpy()
    ends = table.terminal.numpy()
    kind = grid.kind.ravel()
    columns = grid.board.shape[1]
    for cell in np.flatnonzero(grid.open):
        here, colour = cell, PALETTE["grey"]
        for _ in range(_STEPS):
            done = bool(ends[here, action[here]])
            here = after[here, action[here]]
            if done:
                colour = PALETTE["blue"] if kind[here] == 1 else PALETTE["vermilion"]
                break
        row, column = divmod(int(cell), columns)
        down, right = grid.move[action[cell]] * 0.3
        ax.annotate(
            "",
            (column + right, row + down),
            (column - right, row - down),
            arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.1},
        )
