"""Figures of a run, readable without knowing the method.

Everything is drawn with Matplotlib's objects and nothing with pyplot: no global state, no windows.
"""

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike, NDArray

from popl_rl.evaluation.statistics import require_columns
from popl_rl.plotting.style import PALETTE, headline, legend_beside, tidy

__all__ = [
    "learning_curves",
    "occupancy",
    "selection",
]


def occupancy(
    background: NDArray[np.uint8] | None,
    maps: Mapping[str, ArrayLike],
    *,
    suptitle: str,
    caption: str,
) -> Figure:
    """Where each policy spends its steps, over a picture of a grid.

    Args:
        background: Picture of the grid, ``[H, W, 3]`` uint8, covering the same cells as the maps;
            None for plain grey.
        maps: Panel title -> visits of every cell, ``[rows, cols]``; counts or frequencies.
        suptitle: Title of the figure.
        caption: What to look for, below the title.

    Returns:
        One panel per map, on one colour scale; cells that were never visited show the picture.

    Raises:
        ValueError: If there are no maps, or one is not a table of finite non-negative numbers, or
            they differ in shape.
    """
    shares = {title: _shares(title, visits) for title, visits in maps.items()}
    shapes = {share.shape for share in shares.values()}
    if len(shapes) != 1:
        raise ValueError(
            f"maps must hold at least one table and all of one shape, got {sorted(shapes)}"
        )
    rows, cols = shapes.pop()
    lines = math.ceil(len(shares) / 4)
    columns = math.ceil(len(shares) / lines)
    width = max(2.9 * columns + 0.9, 4.5)
    fig = Figure(figsize=(width, lines * (2.7 * max(rows / cols, 0.4) + 0.3) + 1.0))
    headline(fig, suptitle, caption)
    axes = fig.subplots(lines, columns, squeeze=False)
    # Most steps fall on few cells; the root keeps the way there visible.
    norm = PowerNorm(0.5, vmin=0, vmax=max(share.max() for share in shares.values()) or 1)
    colours = ListedColormap(colormaps["inferno"](np.linspace(0.3, 1, 256)))
    extent = (0, cols, rows, 0)
    # Heat leaves a frame in each cell, where the colour of a door or a goal shows.
    inside = np.pad(np.ones((6, 6)), 1)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, share) in zip(axes.flat, shares.items(), strict=False):
        ax.set_title(title, fontsize=11)
        ax.imshow(np.full((1, 1, 3), 230) if background is None else background, extent=extent)
        ax.imshow(
            np.kron(share, np.ones_like(inside)),
            extent=extent,
            norm=norm,
            cmap=colours,
            alpha=np.kron(np.where(share > 0, 0.9, 0), inside),
            interpolation="nearest",
        )
    bar = fig.colorbar(ScalarMappable(norm, colours), ax=axes, shrink=0.8)
    bar.ax.yaxis.set_major_formatter(lambda share, _: f"{100 * share:.3g}%")
    bar.set_label("share of steps")
    return fig


def _shares(title: str, visits: ArrayLike) -> NDArray[np.float64]:
    table = np.asarray(visits, dtype=np.float64)
    if table.ndim != 2 or not np.isfinite(table).all() or (table < 0).any():
        raise ValueError(
            f"maps[{title!r}] must be a table [rows, cols] of finite non-negative visits, got "
            f"shape {table.shape}, from {table.min()} to {table.max()}"
        )
    return table / (table.sum() or 1)


def learning_curves(metrics: pd.DataFrame) -> Figure:
    """How well the population serves the raters, generation by generation.

    Args:
        metrics: Columns ``generation``, ``worst_rater_accuracy``, ``mean_accuracy`` and, optional,
            ``loss_cpl``.

    Raises:
        ValueError: If a column is missing.
    """
    require_columns(metrics, ["generation", "worst_rater_accuracy", "mean_accuracy"])
    with_loss = "loss_cpl" in metrics and metrics["loss_cpl"].notna().any()
    fig = Figure(figsize=(7.5, 5.6 if with_loss else 3.8))
    headline(
        fig,
        "Is anybody left out?",
        "Blue: every rater (or answer) is judged by the member that suits it best, and this is the "
        "worst tenth.",
    )
    ratios = [2, 1] if with_loss else [1]
    axes = fig.subplots(len(ratios), 1, squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    top = axes[0]
    _line(top, metrics, "worst_rater_accuracy", "worst-served tenth,\neach by its best", "blue")
    _line(top, metrics, "mean_accuracy", "everybody,\nby the average member", "grey")
    top.axhline(0.5, color=PALETTE["grey"], linewidth=0.8, linestyle=":")
    legend_beside(top, "guessing", 0.5, PALETTE["grey"])
    top.set_ylabel("training answers\nranked right")
    top.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    if with_loss:
        _line(axes[1], metrics, "loss_cpl", "CPL loss", "orange")
        axes[1].set_ylabel("loss of\nthe children")
    axes[-1].set_xlabel("generation")
    return fig


def selection(metrics: pd.DataFrame) -> Figure:
    """What lexicase selection does, generation by generation.

    Args:
        metrics: Columns ``generation``, ``selection_depth``, ``distinct``, ``effective_parents``.

    Raises:
        ValueError: If a column is missing.
    """
    require_columns(metrics, ["generation", "selection_depth", "distinct", "effective_parents"])
    fig = Figure(figsize=(7.5, 5.2))
    headline(
        fig,
        "Does selection keep many members alive?",
        "Effective parents: as many equally frequent parents would be as diverse.",
    )
    top, bottom = fig.subplots(2, 1, sharex=True)
    _line(top, metrics, "distinct", "members that rank\nthe answers differently", "grey")
    _line(top, metrics, "effective_parents", "effective parents", "blue")
    top.set_ylabel("members")
    _line(bottom, metrics, "selection_depth", "cases used", "orange")
    bottom.set(ylabel="cases until one\nmember is left", xlabel="generation")
    for ax in (top, bottom):
        ax.set_ylim(bottom=0)
    return fig


def _line(ax: Axes, metrics: pd.DataFrame, column: str, label: str, colour: str) -> None:
    rows = metrics[["generation", column]].dropna()
    ax.plot(
        rows["generation"],
        rows[column],
        color=PALETTE[colour],
        linewidth=2,
        marker="o" if len(rows) == 1 else None,
    )
    if len(rows):
        legend_beside(ax, label, rows[column].iloc[-1], PALETTE[colour])
    ax.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    tidy(ax)
