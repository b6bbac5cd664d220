"""Figures of learnt utilities over a line of states, readable without knowing the method."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from popl_rl.evaluation.ranking_agreement import (
    Array,
    checked_table,
)
from popl_rl.plotting.state_lines import (
    curve_of,
    cycled,
    legend_shape,
    line_of_states,
    spaced,
)
from popl_rl.plotting.style import LEGEND, headline, tidy

__all__ = ["Curves", "utilities"]


@dataclass(frozen=True, kw_only=True)
class Curves:
    """What one method has learnt, as utilities of the S states of a figure.

    Attributes:
        members: Hypotheses, such as a population or samples of a posterior, ``[K, S]``.
        best: Group name -> the utility that raters of this group are given, ``[S]``.
        line: The utility that everybody is given, or an average, ``[S]``.
        band: Lower and upper end of a band around ``line``, each ``[S]``.
    """

    members: ArrayLike | None = None
    best: Mapping[str, ArrayLike] | None = None
    line: ArrayLike | None = None
    band: tuple[ArrayLike, ArrayLike] | None = None


def utilities(
    states: ArrayLike, truths: Mapping[str, ArrayLike], held_out: Mapping[str, Curves]
) -> Figure:
    """Learnt utilities beside what the groups really want.

    A utility is known up to its scale and zero only, so that each curve is stretched to reach from
    0 to 1 (a band together with its line); one that is flat lies at 1/2.

    Args:
        states: Position of each state on the line, ``[S]``.
        truths: Group name -> true utility, ``[S]``.
        held_out: Title, such as the name of a method -> what it has learnt.

    Returns:
        A panel per method, with the true utilities in all of them. Of more than 200 members, 200
        are drawn, evenly spaced.

    Raises:
        ValueError: If there are no groups or panels, shapes do not fit, numbers are not finite, a
            panel holds nothing or names a group that there is not.
    """
    at, order, true = line_of_states(states, truths)
    if not held_out:
        raise ValueError("panels must hold at least one method's curves, got none")
    colour = dict(zip(true, cycled(len(true)), strict=True))
    columns = 2 if len(held_out) == 4 else min(len(held_out), 3)
    lines = math.ceil(len(held_out) / columns)
    width = max(3.4 * columns + 0.6, 8.0)
    wishes = [f"what “{name}” really wants" for name in true]
    # Names of what else there may be to explain are shorter.
    across, deep = legend_shape(2 * len(true) + 3, wishes, width, rows=max(len(true), 2))
    fig = Figure(figsize=(width, 2.9 * lines + 1.1 + 0.2 * deep))
    headline(
        fig,
        "What has each method learnt that people want?",
        "Only the shape of a utility matters: every curve is stretched to reach from 0 to 1 (a "
        "band together with its line).",
    )
    axes = fig.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    for ax in axes.flat[len(held_out) :]:
        ax.set_axis_off()
    handles: dict[str, Any] = {}
    for ax, (title, curves) in zip(axes.flat, held_out.items(), strict=False):
        ax.set_title(title, fontsize=11)
        for (name, truth), wish in zip(true.items(), wishes, strict=True):
            style: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.5, "zorder": 4}
            (drawn,) = ax.plot(at, _stretched(truth), color=colour[name], **style)
            handles[wish] = drawn
        for label, drawn in _draw_curves(ax, f"panels[{title!r}]", curves, at, order, colour):
            handles.setdefault(label, drawn)
        ax.set(xlim=(at[0], at[-1]), ylim=(-0.06, 1.06), yticks=(0, 0.5, 1))
        tidy(ax)
    for ax in axes[:, 0]:
        ax.set_ylabel("utility (stretched)")
    for index in range(max(len(held_out) - columns, 0), len(held_out)):
        axes.flat[index].set_xlabel("state")
        axes.flat[index].xaxis.set_tick_params(labelbottom=True)
    # What groups are given comes beside what they want.
    given = [label for label in handles if label.endswith("is given")]
    labels = [*dict.fromkeys([*wishes, *given, *handles])]
    shown = [handles[label] for label in labels]
    fig.legend(shown, labels, loc="outside lower left", ncols=across, **LEGEND)
    return fig


def _draw_curves(
    ax: Axes,
    where: str,
    curves: Curves,
    at: Array,
    order: NDArray[np.int64],
    colour: Mapping[str, str],
) -> list[tuple[str, Any]]:
    """Draw what a method has learnt; return what there is to say about it in a legend."""
    if curves.members is None and curves.best is None and curves.line is None:
        raise ValueError(f"{where} must hold members, best or line, got none of them")
    shown: list[tuple[str, Any]] = []
    if curves.band is not None:
        if curves.line is None:
            raise ValueError(f"{where}.band goes around a line, but there is no line; give both")
        low, high = (curve_of(f"{where}.band", end, at)[order] for end in curves.band)
        middle = curve_of(f"{where}.line", curves.line, at)[order]
        low, middle, high = _stretched(np.stack([low, middle, high]))
        style: dict[str, Any] = {"color": "0.86", "linewidth": 0, "zorder": 1}
        shown.append(("± one standard deviation", ax.fill_between(at, low, high, **style)))
    elif curves.line is not None:
        middle = _stretched(curve_of(f"{where}.line", curves.line, at)[order])
    if curves.members is not None:
        table = checked_table(f"{where}.members", curves.members, at)[:, order]
        table = np.stack([_stretched(member) for member in table[spaced(len(table))]])
        paths = np.stack([np.broadcast_to(at, table.shape), table], -1)
        style = {"colors": [to_rgba("0.35", min(0.5, 8 / len(table) + 0.04))], "zorder": 2}
        ax.add_collection(LineCollection([*paths], linewidths=1, **style))
        shown.append(("one hypothesis of many", Line2D([], [], color="0.6", linewidth=1)))
    for name, curve in (curves.best or {}).items():
        if name not in colour:
            raise ValueError(f"{where}.best must name groups of {[*colour]}, got {name!r}")
        best = _stretched(curve_of(f"{where}.best[{name!r}]", curve, at)[order])
        style = {"color": colour[name], "linewidth": 2.6, "alpha": 0.75, "zorder": 3}
        shown.append((f"what “{name}” is given", ax.plot(at, best, **style)[0]))
    if curves.line is not None:
        (drawn,) = ax.plot(at, middle, color="black", linewidth=1.8, zorder=3)
        shown.append(("one utility for everybody", drawn))
    return shown


def _stretched(curve: Array) -> Array:
    low, high = curve.min(), curve.max()
    return (curve - low) / (high - low) if high > low else np.full_like(curve, 0.5)
