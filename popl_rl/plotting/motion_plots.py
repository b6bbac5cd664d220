"""Pictures of how policies move: quick or gently, by the numbers that an environment measures."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from popl_rl.plotting.style import PALETTE, headline, tidy

__all__ = ["GROUP_COLOURS", "plane", "profiles"]

#: Colours of the groups, in their order.
GROUP_COLOURS = (
    PALETTE["vermilion"],
    PALETTE["blue"],
    PALETTE["green"],
    PALETTE["purple"],
    PALETTE["orange"],
)


def plane(
    points: ArrayLike,
    serves: Sequence[int],
    groups: Sequence[str],
    *,
    measure: str,
    marks: Mapping[str, Sequence[float]],
) -> Figure:
    """Policies in the plane of how soon they do the task and the peak of what is measured.

    Args:
        points: Steps to success and peak of each policy, ``[P, 2]``; NaN for one that never
            succeeds, which is left out.
        serves: Number of the group that each policy serves, ``[P]``.
        groups: Names of the groups.
        measure: What is measured, such as ``hand_speed``.
        marks: Other policies to show, name -> steps and peak.

    Raises:
        ValueError: If shapes do not fit together.
    """
    table = np.asarray(points, dtype=np.float64)
    if table.ndim != 2 or table.shape != (len(serves), 2):
        raise ValueError(f"points must have shape [{len(serves)}, 2], got {table.shape}")
    fig = Figure(figsize=(6.4, 4.6))
    words = measure.replace("_", " ")
    headline(fig, "What the policies of the set do", "A dot is a policy, in its group's colour.")
    ax = fig.subplots()
    for index, name in enumerate(groups):
        chosen = np.asarray(serves) == index
        ax.scatter(
            table[chosen, 0],
            table[chosen, 1],
            s=46,
            color=GROUP_COLOURS[index % len(GROUP_COLOURS)],
            edgecolor="white",
            label=f"serves {name}",
            zorder=3,
        )
    styles = ("*", "X", "P", "D", "v", "^")
    for (name, place), style in zip(marks.items(), styles * len(marks), strict=False):
        ax.scatter(
            [place[0]], [place[1]], s=90, marker=style, color="none", edgecolor="black", label=name
        )
    ax.set_xlabel("steps to success")
    ax.set_ylabel(f"peak {words}")
    ax.set_ylim(bottom=0)
    ax.xaxis.set_major_locator(MaxNLocator(7, integer=True))
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    tidy(ax)
    return fig


def profiles(curves: Mapping[str, ArrayLike], *, measure: str) -> Figure:
    """What is measured over the steps of an episode, a line for each policy.

    Args:
        curves: Name of a policy -> values at each step ``[H]``; NaN from where nobody is left.
        measure: What is measured, such as ``hand_speed``.

    Raises:
        ValueError: If there are no curves.
    """
    if not curves:
        raise ValueError("curves must hold at least one policy, got none")
    fig = Figure(figsize=(7.2, 4.0))
    words = measure.replace("_", " ")
    headline(fig, f"{words.capitalize()} over an episode", "Mean of the episodes that go on.")
    ax = fig.subplots()
    others = (PALETTE["grey"], PALETTE["black"], PALETTE["sky"])
    plain = 0
    for index, (name, values) in enumerate(curves.items()):
        line = np.asarray(values, dtype=np.float64)
        if name.startswith("set,"):
            colour, style = GROUP_COLOURS[index % len(GROUP_COLOURS)], "-"
        else:
            colour, style = others[plain % len(others)], "--"
            plain += 1
        ax.plot(np.arange(len(line)), line, style, color=colour, linewidth=2, label=name)
    ax.set_xlabel("step")
    ax.set_ylabel(words)
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False, fontsize=9)
    tidy(ax)
    return fig
