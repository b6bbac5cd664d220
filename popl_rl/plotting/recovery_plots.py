"""How well each group is served by each method, as bars."""

import itertools

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from popl_rl.evaluation.method_names import method_colour, method_name
from popl_rl.evaluation.statistics import (
    HEADLINES,
    RESULT_COLUMNS,
    entries,
    headline_measure,
    require_columns,
    rows_of,
)
from popl_rl.plotting.style import LEGEND, PALETTE, headline, legend_beside, tidy

__all__ = ["recovery_bars"]

_FREE = ("green", "purple", "vermilion")  # colours for methods that have none of their own
_CAPTIONS = {
    "share_of_optimum": "Share of optimum: (return − random) / (optimum − random), exact, in the "
    "group's own utility.",
    "recovery": "Recovery: (return − floor) / (oracle's return − floor), in the group's own "
    "utility.",
}


def recovery_bars(results: pd.DataFrame, *, floor: str = "random actions") -> Figure:
    """How much of what is possible each group gets from each method.

    Args:
        results: Tidy rows ``method, choice, group, measure, value``; those of the headline measure
            (``popl_rl.evaluation.statistics.headline_measure``) are drawn. Several rows of a
            method, choice and group, such as seeds, are averaged and dotted.
        floor: What a recovery of 0 is.

    Returns:
        A bar for each group, method and choice.

    Raises:
        ValueError: If a column is missing, or no row of the measure holds a number.
    """
    require_columns(results, RESULT_COLUMNS)
    measure = headline_measure(results)
    rows = results[(results["measure"] == measure) & results["value"].notna()]
    # 0 by definition for every group, as a recovery of the oracle is 1; lines show them.
    optimal = measure == "share_of_optimum"
    rows = rows[~rows["method"].isin(["random"] if optimal else ["oracle", "random"])]
    if rows.empty:
        raise ValueError(
            f"results must hold rows of measure {measure!r} of a method other than oracle and "
            f"random, got measures {sorted(results['measure'].unique())}; run the baselines too"
        )
    methods, groups = entries(rows), list(rows["group"].unique())
    low = -0.5 if rows["value"].min() < 0 else 0.0
    high = 1.25
    fig = Figure(figsize=(max(4.0, len(groups) * (0.5 * len(methods) + 0.4)) + 2.6, 4.2))
    headline(fig, "How well is each group served?", _CAPTIONS[measure])
    ax = fig.subplots()
    width = 0.8 / len(methods)
    others = itertools.cycle(_FREE)
    for index, entry in enumerate(methods):
        colour = PALETTE[method_colour(*entry) or next(others)]
        label = method_name(*entry)
        of_method = rows_of(rows, *entry)
        for place, group in enumerate(groups):
            values = of_method.loc[of_method["group"] == group, "value"].to_numpy(dtype=float)
            if not len(values):
                continue
            x = place + (index - (len(methods) - 1) / 2) * width
            mean = values.mean()
            ax.bar(x, np.clip(mean, low, high), 0.92 * width, color=colour, label=label)
            label = "_" + label  # one entry in the legend is enough
            if len(values) > 1:
                spread = x + np.linspace(-0.25, 0.25, len(values)) * width
                ax.scatter(spread, values, s=12, color="white", edgecolors="black", zorder=3)
            _value(ax, x, mean, values, low, high)
    ax.axhline(1, color="black", linewidth=1, linestyle="--", zorder=0)
    ax.axhline(0, color="black", linewidth=1)
    legend_beside(ax, "the optimum" if optimal else "as good as the oracle", 1, "black")
    legend_beside(ax, f"as good as\n{'random actions' if optimal else floor}", 0, "black")
    ax.set_xticks(range(len(groups)), [f"“{group}”" for group in groups])
    ax.tick_params(axis="x", length=0)
    ax.set(xlabel="raters who want", ylabel=HEADLINES[measure])
    ax.set_ylim(low and low - 0.2, high + 0.15)
    fig.legend(loc="outside lower center", ncols=min(len(methods), 3), **LEGEND)
    tidy(ax)
    return fig


def _value(
    ax: Axes, x: float, mean: float, values: NDArray[np.float64], low: float, high: float
) -> None:
    """Write a bar's value beyond its end, with an arrow where the bar is cut off."""
    up = mean >= 0
    end = float(np.clip(values.max() if up else values.min(), low, high))
    arrow = " ↑" if mean > high else " ↓" if mean < low else ""
    ax.annotate(
        f"{mean:.2f}{arrow}".replace("-", "−"),
        (x, end),
        xytext=(0, 5 if up else -5),
        textcoords="offset points",
        ha="center",
        va="bottom" if up else "top",
        fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
    )
