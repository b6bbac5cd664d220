"""Figure of how the members of a population spread over what the groups want."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike, NDArray

from popl_rl.plotting.style import LEGEND, MEMBER_COLOURS, PALETTE, headline, tidy

__all__ = ["members"]


def members(
    accuracy: ArrayLike,
    generations: Sequence[int],
    group_names: Sequence[str],
    *,
    catered: Mapping[str, int],
    pooled: ArrayLike | None = None,
    oracle: Mapping[str, ArrayLike] | None = None,
) -> Figure:
    """How the population spreads over what the groups want.

    Args:
        accuracy: Share of each group's held-out pairs that each member ranks as that group does,
            ``[generation, member, group]``.
        generations: Generation of each slice of ``accuracy``.
        group_names: Names of the G groups, at least 2.
        catered: Group name -> member of the last generation that its raters are given.
        pooled: Accuracies of the policy that was trained on everybody's answers, ``[group]``.
        oracle: Group name -> accuracies of the policy that was trained on that group's answers
            alone, ``[group]``.

    Returns:
        A panel for each pair of groups, at most 6: a dot for each member.

    Raises:
        ValueError: If the shapes or the group names do not fit together.
    """
    values = _checked(accuracy, generations, group_names, [*catered, *(oracle or {})])
    marks = [*_marks(values[-1], group_names, catered, pooled, oracle or {})]
    points = np.concatenate([values.reshape(-1, len(group_names)), *(m.point[None] for m in marks)])
    low, high = np.nanmin(points), np.nanmax(points)
    low, high = low - 0.06 * max(high - low, 0.1), high + 0.16 * max(high - low, 0.1)
    pairs = list(itertools.combinations(range(len(group_names)), 2))[:6]
    columns = min(len(pairs), 3)
    lines = math.ceil(len(pairs) / columns)
    size = 5.0 if len(pairs) == 1 else 3.0
    width = size * columns + 1.6
    fig = Figure(figsize=(width, (size - 0.35) * lines + 1.7))
    headline(
        fig,
        "Does every group find a policy of its own?",
        "Each dot is a member of the population: how often it ranks unseen pairs as a group does.\n"
        "Dotted lines: guessing.",
    )
    axes = fig.subplots(lines, columns, squeeze=False)
    norm = Normalize(min(*generations, max(generations) - 1), max(generations))
    colours = ListedColormap(colormaps["Greys"](np.linspace(0.22, 0.85, 256)))
    for ax in axes.flat[len(pairs) :]:
        ax.set_axis_off()
    shown = {}
    for ax, (x, y) in zip(axes.flat, pairs, strict=False):
        for generation, slice_ in zip(generations, values, strict=True):
            colour = colours(norm(generation))
            ax.scatter(slice_[:, x], slice_[:, y], s=14, color=colour, linewidths=0)
        for mark in marks:
            if mark.group in (None, x, y):
                shown[mark.label] = ax.scatter(
                    mark.point[x], mark.point[y], label=mark.label, **mark.style
                )
        _lay_out(ax, group_names[x], group_names[y], (low, high))
    if len(generations) > 1:
        ticks = MaxNLocator(5, integer=True)
        bar = fig.colorbar(ScalarMappable(norm, colours), ax=axes, shrink=0.6, ticks=ticks)
        bar.set_label("generation of a member")
    if shown:
        labels = [mark.label for mark in marks if mark.label in shown]
        # Two rows, filled column by column, keep what belongs to a group together.
        ncols = min(math.ceil(len(labels) / 2), int(width / 2.1))
        handles = [shown[label] for label in labels]
        fig.legend(handles, labels, loc="outside lower left", ncols=ncols, **LEGEND)
    return fig


def _checked(
    accuracy: ArrayLike,
    generations: Sequence[int],
    group_names: Sequence[str],
    named: Sequence[str],
) -> NDArray[np.float64]:
    """Return the accuracies as an array, once shapes and names fit together."""
    values = np.asarray(accuracy, dtype=np.float64)
    expected = (len(generations), len(group_names))
    if values.ndim != 3 or (values.shape[0], values.shape[2]) != expected or expected[1] < 2:
        raise ValueError(
            "accuracy must be [generation, member, group] for "
            f"{len(generations)} generations and {len(group_names)} groups (at least 2), got shape "
            f"{values.shape}"
        )
    unknown = [name for name in named if name not in group_names]
    if unknown:
        raise ValueError(f"catered and oracle must name groups of {group_names}, got {unknown}")
    return values


def _lay_out(ax: Axes, x: str, y: str, limits: tuple[float, float]) -> None:
    """Draw what a panel of two groups has besides members: guessing, labels, what corners mean."""
    ax.axhline(0.5, color=PALETTE["grey"], linewidth=0.8, linestyle=":")
    ax.axvline(0.5, color=PALETTE["grey"], linewidth=0.8, linestyle=":")
    ax.set(xlabel=f"agrees with “{x}”", ylabel=f"agrees with “{y}”", aspect="equal")
    ax.set(xlim=limits, ylim=limits)
    _corner(ax, f"only “{y}”", 0.02, "left")
    _corner(ax, "suits both", 0.98, "right")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(PercentFormatter(1, decimals=0))
    tidy(ax)


@dataclass(frozen=True)
class _Mark:
    """A policy to point out; ``group`` None where it belongs to all."""

    label: str
    point: NDArray[np.float64]
    group: int | None
    style: dict[str, Any]


def _marks(
    last: NDArray[np.float64],
    group_names: Sequence[str],
    catered: Mapping[str, int],
    pooled: ArrayLike | None,
    oracle: Mapping[str, ArrayLike],
) -> Iterator[_Mark]:
    for index, (name, colour) in enumerate(zip(group_names, itertools.cycle(MEMBER_COLOURS))):
        if name in catered:
            ring = {"s": 110, "facecolors": "none", "edgecolors": colour, "linewidths": 2.2}
            yield _Mark(f"POPL for “{name}”", last[catered[name]], index, ring)
        if name in oracle:
            star = {"s": 120, "marker": "*", "color": colour}
            yield _Mark(f"oracle of “{name}”", np.asarray(oracle[name], float), index, star)
    if pooled is not None:
        cross = {"s": 80, "marker": "X", "color": PALETTE["orange"], "edgecolors": "black"}
        yield _Mark("one policy for everybody", np.asarray(pooled, float), None, cross)


def _corner(ax: Axes, text: str, x: float, side: str) -> None:
    ax.text(
        x,
        0.985,
        text,
        transform=ax.transAxes,
        ha=side,
        va="top",
        fontsize=8,
        style="italic",
        color=PALETTE["grey"],
    )
