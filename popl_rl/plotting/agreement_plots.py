"""Figure of who agrees with whom about which of two states is better."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import ArrayLike, NDArray

from popl_rl.evaluation.ranking_agreement import (
    Array,
    alike,
    checked_table,
    order_by_agreement,
    rank_shares,
)
from popl_rl.plotting.state_lines import cycled, ends, line_of_states, spaced
from popl_rl.plotting.style import headline

__all__ = ["agreement"]

_AGREE = colormaps["PRGn"].with_extremes(bad="0.82")


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
    at, order, true = line_of_states(states, truths)
    near = spaced(len(at))
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
            zip(true.items(), cycled(len(true)), strict=True)
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
            ax.set(aspect="equal", xticks=ends(at), yticks=ends(at) if column == 0 else ())
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
    some = table[spaced(len(table))]
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
        for text, hue in zip(axis.get_ticklabels()[:-1], cycled(groups), strict=True):
            text.set_color(hue)
    ax.invert_yaxis()
    ax.set_aspect("equal")
    ax.tick_params(length=0, labelsize=9)
    return mesh


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
