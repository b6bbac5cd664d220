"""Figure of what the majority prefers, and of three states that it prefers in a circle."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.ticker import PercentFormatter
from numpy.typing import ArrayLike

from popl_rl.evaluation.ranking_agreement import (
    Array,
    checked_table,
)
from popl_rl.plotting.state_lines import cycled, legend_shape, line_of_states
from popl_rl.plotting.style import LEGEND, PALETTE, headline, tidy
from popl_rl.raters.condorcet import find_cycle

__all__ = ["majority_figure"]

_PREFER = colormaps["PuOr"].with_extremes(bad="0.82")


def majority_figure(
    states: ArrayLike,
    truths: Mapping[str, ArrayLike],
    preferred: ArrayLike,
    *,
    cycle: Sequence[int] | None = None,
) -> Figure:
    """What the majority of all raters prefers, and three states that it prefers in a circle.

    Args:
        states: Position of each state on the line, ``[S]``.
        truths: Group name -> true utility, ``[S]``.
        preferred: Share of the raters who prefer state i to state j, ``[S, S]``, from
            ``popl_rl.raters.condorcet.majority_preference``.
        cycle: Indices of three states of which the first beats the second, this the third, and this
            the first; what ``popl_rl.raters.condorcet.find_cycle`` finds if None.

    Returns:
        What each group wants, with the three states marked; the majorities for all pairs; and the
        circle with its majorities. Without a circle the last panel says so.

    Raises:
        ValueError: If shapes do not fit together, numbers are not finite, or ``cycle`` is no three
            states.
    """
    at, order, true = line_of_states(states, truths)
    if np.shape(preferred) != (len(at), len(at)):
        raise ValueError(
            f"preferred must have shape [{len(at)}, {len(at)}], got {[*np.shape(preferred)]}"
        )
    table = checked_table("preferred", preferred, at)
    found = find_cycle(torch.from_numpy(table)) if cycle is None else list(cycle)
    if found is not None and (len(set(found)) != 3 or not set(found) <= set(range(len(at)))):
        raise ValueError(f"cycle must be three of the states 0 to {len(at) - 1}, got {found}")
    marked = {} if found is None else dict(zip("ABC", np.asarray(states)[found], strict=True))
    across, deep = legend_shape(len(true), [f"what “{name}” wants" for name in true], 12.6)
    fig = Figure(figsize=(12.6, 4.5 + 0.2 * deep))
    headline(
        fig,
        "Can the majority's wish be put in one order?",
        "Each group can say which of two states is better. Where the majority prefers A to B, B to "
        "C and C to A, no single utility can say what it wants.",
    )
    left, middle, right = fig.subplots(1, 3, width_ratios=[1.15, 1.1, 1])
    for index, ((name, truth), hue) in enumerate(zip(true.items(), cycled(len(true)), strict=True)):
        # Thinner and thinner, so that lines on top of each other are all seen.
        width = 2 + 2 * (len(true) - 1 - index) / len(true)
        left.plot(at, truth, color=hue, linewidth=width, label=f"what “{name}” wants")
    left.set(xlabel="state", ylabel="utility", xlim=(at[0], at[-1]))
    left.set_title("what each group wants", fontsize=11, pad=18)
    tidy(left)
    fig.legend(loc="outside lower left", ncols=across, **LEGEND)
    shown = table[np.ix_(order, order)]
    mesh = middle.pcolormesh(at, at, shown, cmap=_PREFER, vmin=0, vmax=1, shading="nearest")
    middle.set(aspect="equal", xlabel="another state", ylabel="one state")
    middle.set_title("what the majority says of any two", fontsize=11, pad=18)
    bar = fig.colorbar(mesh, ax=middle, shrink=0.75)
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    bar.set_label("raters who prefer the one to the other", labelpad=8)
    for letter, state in marked.items():
        left.axvline(state, color=PALETTE["grey"], linewidth=1, linestyle=":")
        _above(left, letter, state)
        _above(middle, letter, state)
        _beside(middle, letter, state)
    if found is not None:
        for one, other in zip(found, [*found[1:], found[0]], strict=True):
            x, y = np.asarray(states)[[other, one]]
            middle.plot(x, y, "o", color="black", markersize=6, markerfacecolor="none")
    _draw_circle(right, found, marked, table)
    return fig


def _draw_circle(
    ax: Axes, found: Sequence[int] | None, marked: Mapping[str, float], table: Array
) -> None:
    ax.set(xlim=(-1.75, 1.75), ylim=(-1.6, 1.7), aspect="equal")
    ax.set_axis_off()
    if found is None:
        ax.text(0, 0, "No three states\nare preferred in a circle.", ha="center", va="center")
        return
    ax.set_title("the majority goes round in a circle", fontsize=11, pad=18)
    corners = np.array([(np.sin(turn), np.cos(turn)) for turn in 2 * np.pi / 3 * np.arange(3)])
    letters = [*marked]
    for index, (letter, state) in enumerate(marked.items()):
        after = (index + 1) % 3
        # Arrows go along the circle through the three states, clear of their discs.
        arc = FancyArrowPatch(
            (corners[index][0], corners[index][1]),
            (corners[after][0], corners[after][1]),
            connectionstyle="arc3,rad=-0.25",
            arrowstyle="-|>",
            mutation_scale=18,
            shrinkA=30,
            shrinkB=30,
            linewidth=2,
            color="black",
        )
        ax.add_patch(arc)
        share = table[found[index], found[after]]
        x, y = -1.15 * corners[(index + 2) % 3]
        said = f"{100 * share:.0f}% prefer\n{letter} to {letters[after]}"
        side = ("left", "center", "right")[index]
        ax.text(x - 0.25 * (1 - index), y, said, ha=side, va="center", fontsize=9)
        x, y = corners[index]
        ax.add_patch(Circle((x, y), 0.36, facecolor="0.92", edgecolor="black"))
        ax.text(x, y, f"{letter}\n{state:.2f}", ha="center", va="center", weight="bold")


def _above(ax: Axes, text: str, x: float) -> None:
    """Write a letter on the upper edge of the axes."""
    ax.annotate(
        text,
        (x, 1),
        xycoords=("data", "axes fraction"),
        xytext=(0, 2),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=9,
        weight="bold",
    )


def _beside(ax: Axes, text: str, y: float) -> None:
    """Write a letter on the right edge of the axes."""
    ax.annotate(
        text,
        (1, y),
        xycoords=("axes fraction", "data"),
        xytext=(3, 0),
        textcoords="offset points",
        va="center",
        fontsize=9,
        weight="bold",
    )
