"""Figures of learnt utilities over a line of states, readable without knowing the method."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.ticker import PercentFormatter
from numpy.typing import ArrayLike, NDArray

from popl_rl.evaluation.ranking_agreement import (
    Array,
    alike,
    checked_table,
    order_by_agreement,
    rank_shares,
)
from popl_rl.plotting.style import LEGEND, MEMBER_COLOURS, PALETTE, headline, tidy
from popl_rl.raters.condorcet import find_cycle

__all__ = ["Curves", "agreement", "majority_figure", "utilities"]

_MOST = 200  # lines and rows that a figure has room for
_AGREE = colormaps["PRGn"].with_extremes(bad="0.82")
_PREFER = colormaps["PuOr"].with_extremes(bad="0.82")


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
    at, order, true = _line_of_states(states, truths)
    if not held_out:
        raise ValueError("panels must hold at least one method's curves, got none")
    colour = dict(zip(true, _cycled(len(true)), strict=True))
    columns = 2 if len(held_out) == 4 else min(len(held_out), 3)
    lines = math.ceil(len(held_out) / columns)
    width = max(3.4 * columns + 0.6, 8.0)
    wishes = [f"what “{name}” really wants" for name in true]
    # Names of what else there may be to explain are shorter.
    across, deep = _legend_shape(2 * len(true) + 3, wishes, width, rows=max(len(true), 2))
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
        low, high = (_curve(f"{where}.band", end, at)[order] for end in curves.band)
        middle = _curve(f"{where}.line", curves.line, at)[order]
        low, middle, high = _stretched(np.stack([low, middle, high]))
        style: dict[str, Any] = {"color": "0.86", "linewidth": 0, "zorder": 1}
        shown.append(("± one standard deviation", ax.fill_between(at, low, high, **style)))
    elif curves.line is not None:
        middle = _stretched(_curve(f"{where}.line", curves.line, at)[order])
    if curves.members is not None:
        table = checked_table(f"{where}.members", curves.members, at)[:, order]
        table = np.stack([_stretched(member) for member in table[_spaced(len(table))]])
        paths = np.stack([np.broadcast_to(at, table.shape), table], -1)
        style = {"colors": [to_rgba("0.35", min(0.5, 8 / len(table) + 0.04))], "zorder": 2}
        ax.add_collection(LineCollection([*paths], linewidths=1, **style))
        shown.append(("one hypothesis of many", Line2D([], [], color="0.6", linewidth=1)))
    for name, curve in (curves.best or {}).items():
        if name not in colour:
            raise ValueError(f"{where}.best must name groups of {[*colour]}, got {name!r}")
        best = _stretched(_curve(f"{where}.best[{name!r}]", curve, at)[order])
        style = {"color": colour[name], "linewidth": 2.6, "alpha": 0.75, "zorder": 3}
        shown.append((f"what “{name}” is given", ax.plot(at, best, **style)[0]))
    if curves.line is not None:
        (drawn,) = ax.plot(at, middle, color="black", linewidth=1.8, zorder=3)
        shown.append(("one utility for everybody", drawn))
    return shown


def _stretched(curve: Array) -> Array:
    low, high = curve.min(), curve.max()
    return (curve - low) / (high - low) if high > low else np.full_like(curve, 0.5)


def agreement(
    states: ArrayLike,
    truths: Mapping[str, ArrayLike],
    members: ArrayLike,
    *,
    catered: Mapping[str, int | Sequence[int]] | None = None,
) -> Figure:
    """Who agrees with whom about which of two states is better.

    Args:
        states: Position of each state on the line, ``[S]``.
        truths: Group name -> true utility, ``[S]``.
        members: Utilities of the K members of a population, ``[K, S]``.
        catered: Group name -> the member, or each of the members, that raters of this group were
            given. One that was given to several raters counts as often.

    Returns:
        On the left, for each group and pair of states, the share of the population that ranks the
        pair as the group does, and below it the same of the members that its raters were given; on
        the right, how alike the members are, like beside like, and how alike to the groups. Of more
        than 200 states, 200 are compared, evenly spaced, and so of members on the right.

    Raises:
        ValueError: If there are no groups or members, shapes do not fit, numbers are not finite, or
            ``catered`` names a group or member that there is not.
    """
    at, order, true = _line_of_states(states, truths)
    near = _spaced(len(at))
    table = checked_table("members", members, at)[:, order][:, near]
    at, true = at[near], {name: truth[near] for name, truth in true.items()}
    chosen = {name: _chosen(name, who, true, len(table)) for name, who in (catered or {}).items()}
    rows = {"the whole population": {name: np.arange(len(table)) for name in true}}
    if chosen:
        rows["who was chosen for the group"] = chosen
    size = 2.4 if len(rows) == 2 else 2.9
    ratio = 1.05 * len(rows)
    fig = Figure(figsize=(size * (len(true) + ratio) + 2.2, size * len(rows) + 1.2))
    headline(
        fig,
        "Who agrees with whom?",
        "Left: the share that ranks two states as a group of raters does; 50% is what guessing "
        "gives.\nRight: the share of such pairs that two members rank alike. Ties are no "
        "agreement; grey: the group does not care.",
    )
    # Apart, so that labels on one side take no room on the other.
    left, right = fig.subfigures(1, 2, squeeze=False, width_ratios=[len(true), ratio])[0]
    axes = left.subplots(len(rows), len(true), squeeze=False)
    for line, (label, who) in enumerate(rows.items()):
        for column, ((name, truth), hue) in enumerate(
            zip(true.items(), _cycled(len(true)), strict=True)
        ):
            ax = axes[line, column]
            if name not in who:
                ax.set_axis_off()
                continue
            share = rank_shares(table[who[name]], truth)
            ax.pcolormesh(at, at, share, cmap=_AGREE, vmin=0, vmax=1, shading="nearest")
            cares = np.isfinite(share).any()
            mean = f"{100 * np.nanmean(share):.0f}%" if cares else "nothing to rank"
            ax.set_title(f"with “{name}”\n{mean}", fontsize=9, color=hue)
            ax.set(aspect="equal", xticks=_ends(at), yticks=_ends(at) if column == 0 else ())
            if column == 0:
                ax.set_ylabel(f"{label}\n\none state")
            if line == len(rows) - 1:
                ax.set_xlabel("another state")
    whole = right.subplots()
    mesh = _draw_likeness(whole, table, true)
    bar = right.colorbar(mesh, ax=whole, shrink=0.7)
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    bar.set_label("agreement")
    return fig


def _draw_likeness(ax: Axes, table: Array, true: Mapping[str, Array]) -> Any:
    """Draw how alike members and groups are; the groups' rows are thick and stand apart."""
    some = table[_spaced(len(table))]
    likeness = alike(some, true)
    groups = len(true)
    members = groups + order_by_agreement(likeness[groups:, groups:])
    # Whoever agrees most with the first group comes first.
    place = np.arange(len(members)) - (len(members) - 1) / 2
    if place @ likeness[0, members] > 0:
        members = members[::-1]
    thick, gap = max(len(some) / 12, 0.5), max(len(some) / 40, 0.2)
    widths = [*[thick] * groups, gap, *[1.0] * len(some)]
    edges = np.concatenate([[0.0], np.cumsum(widths)])
    rows = np.concatenate([np.arange(groups), members])
    shown = np.insert(likeness[np.ix_(rows, rows)], groups, np.nan, 0)
    shown = np.insert(shown, groups, np.nan, 1)
    # The gap is white; grey would mean that nobody cares.
    colours = _AGREE.with_extremes(bad="white")
    mesh = ax.pcolormesh(edges, edges, shown, cmap=colours, vmin=0, vmax=1)
    ticks = [*(thick * (np.arange(groups) + 0.5)), (edges[groups + 1] + edges[-1]) / 2]
    labels = [
        *(f"“{name}”" for name in true),
        f"{len(some)} member{'s' * (len(some) > 1)},\nlike beside like",
    ]
    ax.xaxis.tick_top()
    ax.set_xticks(ticks, labels)
    ax.set_yticks(ticks, labels)
    # Names of groups stand upright over their narrow columns, that of the members beside its rows.
    for label in [*ax.get_xticklabels()[:-1], ax.get_yticklabels()[-1]]:
        label.set_rotation(90)
    ax.get_yticklabels()[-1].set_verticalalignment("center")
    ax.get_xticklabels()[-1].set_verticalalignment("bottom")
    for axis in (ax.xaxis, ax.yaxis):
        for text, hue in zip(axis.get_ticklabels()[:-1], _cycled(groups), strict=True):
            text.set_color(hue)
    ax.invert_yaxis()
    ax.set_aspect("equal")
    ax.tick_params(length=0, labelsize=9)
    return mesh


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
            :func:`~popl_rl.raters.condorcet.majority_preference`.
        cycle: Indices of three states of which the first beats the second, this the third, and this
            the first; what :func:`~popl_rl.raters.condorcet.find_cycle` finds if None.

    Returns:
        What each group wants, with the three states marked; the majorities for all pairs; and the
        circle with its majorities. Without a circle the last panel says so.

    Raises:
        ValueError: If shapes do not fit together, numbers are not finite, or ``cycle`` is no three
            states.
    """
    at, order, true = _line_of_states(states, truths)
    if np.shape(preferred) != (len(at), len(at)):
        raise ValueError(
            f"preferred must have shape [{len(at)}, {len(at)}], got {[*np.shape(preferred)]}"
        )
    table = checked_table("preferred", preferred, at)
    found = find_cycle(torch.from_numpy(table)) if cycle is None else list(cycle)
    if found is not None and (len(set(found)) != 3 or not set(found) <= set(range(len(at)))):
        raise ValueError(f"cycle must be three of the states 0 to {len(at) - 1}, got {found}")
    marked = {} if found is None else dict(zip("ABC", np.asarray(states)[found], strict=True))
    across, deep = _legend_shape(len(true), [f"what “{name}” wants" for name in true], 12.6)
    fig = Figure(figsize=(12.6, 4.5 + 0.2 * deep))
    headline(
        fig,
        "Can the majority's wish be put in one order?",
        "Each group can say which of two states is better. Where the majority prefers A to B, B to "
        "C and C to A, no single utility can say what it wants.",
    )
    left, middle, right = fig.subplots(1, 3, width_ratios=[1.15, 1.1, 1])
    for index, ((name, truth), hue) in enumerate(
        zip(true.items(), _cycled(len(true)), strict=True)
    ):
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
        middle.annotate(
            letter,
            (1, state),
            xycoords=("axes fraction", "data"),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=9,
            weight="bold",
        )
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


def _line_of_states(
    states: ArrayLike, truths: Mapping[str, ArrayLike]
) -> tuple[Array, NDArray[np.int64], dict[str, Array]]:
    """Return the states in their order on the line, this order, and the truths in it."""
    at = np.asarray(states, dtype=np.float64)
    if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all():
        raise ValueError(f"states must be at least 2 finite positions [S], got shape {at.shape}")
    if not truths:
        raise ValueError("truths must hold at least one group's utility, got none")
    order = np.argsort(at, kind="stable")
    true = {name: _curve(f"truths[{name!r}]", curve, at)[order] for name, curve in truths.items()}
    return at[order], order, true


def _curve(what: str, curve: ArrayLike, at: Array) -> Array:
    values: Array = np.asarray(curve, dtype=np.float64)
    if values.shape != at.shape:
        raise ValueError(f"{what} must have shape [{len(at)} states], got {values.shape}")
    checked_table(what, values[None], at)
    return values


def _chosen(
    name: str, who: int | Sequence[int], true: Mapping[str, Array], members: int
) -> NDArray[np.int64]:
    chosen = np.atleast_1d(np.asarray(who))
    if name not in true:
        raise ValueError(f"catered must name groups of {[*true]}, got {name!r}")
    if not len(chosen) or not set(chosen.tolist()) <= set(range(members)):
        raise ValueError(
            f"catered[{name!r}] must be one or more of the members 0 to {members - 1}, got {who}"
        )
    return chosen.astype(np.int64)


def _spaced(count: int) -> NDArray[np.int64]:
    """Return evenly spaced indices of at most as many rows as there is room for."""
    return np.linspace(0, count - 1, min(count, _MOST)).round().astype(np.int64)


def _legend_shape(
    entries: int, labels: Sequence[str], width: float, *, rows: int = 1
) -> tuple[int, int]:
    """Return columns and rows of a legend with room for long labels below a figure, in inches."""
    fitting = int((width - 0.2) / (0.6 + 0.078 * max(map(len, labels))))
    columns = max(1, min(fitting, math.ceil(entries / rows)))
    return columns, math.ceil(entries / columns)


def _cycled(count: int) -> list[str]:
    return [MEMBER_COLOURS[index % len(MEMBER_COLOURS)] for index in range(count)]


def _ends(at: Array) -> tuple[float, float]:
    return round(float(at[0]), 2), round(float(at[-1]), 2)
