"""Figures of a benchmark: how well each method serves the groups, and what changes it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator, PercentFormatter
from numpy.typing import NDArray

from popl_rl.evaluation.statistics import entries, interval, rows_of, worst
from popl_rl.evaluation.suite import Suite
from popl_rl.plotting.benchmark_style import (
    BASELINE_COLOURS,
    axis_positions,
    ends_of_scale,
    explain_headline,
    headline_name,
    method_columns,
    method_styles,
)
from popl_rl.plotting.style import LEGEND, PALETTE, headline, legend_beside, tidy

__all__ = ["scenario_bars", "sweep_panels"]

_LOWEST, _HIGHEST = -0.5, 1.25  # recoveries beyond are cut off


def scenario_bars(suite: Suite, results: pd.DataFrame) -> Figure:
    """The worst-served group's headline: a bar for each scenario and method.

    Args:
        suite: The suite.
        results: Rows as of ``popl_rl.experiments.cells.collect``; scenarios and methods without
            recoveries are left out.

    Returns:
        Bars of means over seeds with their 95 % intervals, and a dot for each seed.

    Raises:
        ValueError: If no recovery is known.
    """
    table = worst(results)
    if table.empty:
        raise ValueError("results must hold the recovery of some method in every group, got none")
    methods = suite.ordered(entries(table))
    scenarios = list(table["scenario"].unique())
    fig = Figure(figsize=(max(5.0, len(scenarios) * (0.28 * len(methods) + 0.35)) + 2.4, 4.4))
    headline(
        fig,
        "How well is the worst-served group served?",
        f"{explain_headline(table)}, cut off below −0.5.\n"
        "Dots are seeds, bars their mean with its 95 % interval.",
    )
    ax = fig.subplots()
    width = 0.84 / len(methods)
    styles = method_styles(suite, [method for method, _ in methods])
    for index, (method, choice) in enumerate(methods):
        label = suite.label(method, choice)
        colour = styles[method][0]
        catered_otherwise = choice == "lexicase"
        of_method = rows_of(table, method, choice)
        for place, scenario in enumerate(scenarios):
            chosen = of_method["scenario"] == scenario
            values = of_method.loc[chosen, "value"].to_numpy(dtype=float)
            if not len(values):
                continue
            x = place + (index - (len(methods) - 1) / 2) * width
            mean, half = interval(values)
            ax.bar(
                x,
                np.clip(mean, _LOWEST, _HIGHEST),
                0.9 * width,
                label=label,
                color="white" if catered_otherwise else colour,
                edgecolor=colour,
                hatch="////" if catered_otherwise else None,
            )
            label = "_" + label  # one entry in the legend is enough
            if len(values) > 1:
                ax.errorbar(x, mean, half, color="black", linewidth=1, capsize=2)
                ax.scatter(np.full(len(values), x), values, s=7, color=PALETTE["grey"], zorder=3)
    ax.axhline(1, color="black", linewidth=1, linestyle="--", zorder=0)
    ax.axhline(0, color="black", linewidth=1)
    one, zero = ends_of_scale(table)
    legend_beside(ax, one, 1, "black")
    legend_beside(ax, zero, 0, "black")
    low = _LOWEST if table["value"].min() < 0 else 0.0
    ax.set(ylabel=headline_name(table), ylim=(low, _HIGHEST))
    ax.set_xticks(range(len(scenarios)), [name.replace("_", "\n", 1) for name in scenarios])
    ax.tick_params(axis="x", length=0)
    fig.legend(loc="outside lower center", ncols=method_columns(fig), **LEGEND)
    tidy(ax)
    return fig


def sweep_panels(suite: Suite, results: pd.DataFrame) -> Figure:
    """Accuracy along each axis of a suite: a column of panels per axis, a row per group.

    Args:
        suite: A suite with axes.
        results: Rows as of ``popl_rl.experiments.cells.collect``.

    Returns:
        A line for each method that runs along the axis: solid for what new raters are given, with
        95 % intervals over seeds as bands; dashed for the best member.

    Raises:
        ValueError: If no method has accuracies at two points of an axis.
    """
    table = results[results["measure"].isin(["accuracy", "best_accuracy"])]
    # Of what methods are compared with, only what bounds them: more lines cannot be read.
    shown = table["method"].isin([*suite.methods, *BASELINE_COLOURS]) & (
        table["choice"] != "lexicase"
    )
    table = table[shown & table["value"].notna()]
    drawn = {}
    for axis, points in suite.axes().items():
        of_axis = table[table["scenario"].isin(list(points))]
        along = of_axis.groupby("method")["scenario"].transform("nunique") > 1
        if along.any():
            drawn[axis] = of_axis[along]
    if not drawn:
        raise ValueError("results must hold accuracies at two points of an axis, got none")
    found = pd.concat(drawn.values())
    groups = list(found["group"].unique())
    methods = list(dict.fromkeys(method for method, _ in suite.ordered(entries(found))))
    styles = method_styles(suite, methods)
    fig = Figure(figsize=(max(2.5 * len(drawn) + 0.8, 5.0), 2.1 * len(groups) + 1.8))
    headline(
        fig,
        "How well is each group understood?",
        "Solid: by what new raters are given, with 95 % intervals over seeds.\n"
        "Dashed: by the best member.",
    )
    axes = fig.subplots(len(groups), len(drawn), squeeze=False, sharex="col", sharey=True)
    for column, (axis, rows) in enumerate(drawn.items()):
        points = {
            name: x for name, x in suite.axes()[axis].items() if name in set(rows["scenario"])
        }
        x = axis_positions(list(points.values()))
        for row, group in enumerate(groups):
            ax = axes[row, column]
            of_group = rows[rows["group"] == group]
            for method in methods:
                _curves(ax, of_group[of_group["method"] == method], points, x, styles[method])
            ax.set_xticks(x, [str(value) for value in points.values()])
            ax.xaxis.set_minor_locator(NullLocator())
            ax.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
            ax.axhline(0.5, color=PALETTE["grey"], linewidth=0.8, linestyle=":")
            tidy(ax)
            if column == 0:
                ax.set_ylabel(f"accuracy on\n“{group}”")
        axes[-1, column].set_xlabel(axis)
    handles = [
        Line2D([], [], color=styles[name][0], marker=styles[name][1], label=suite.label(name))
        for name in methods
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=method_columns(fig), **LEGEND)
    return fig


def _curves(
    ax: Axes,
    rows: pd.DataFrame,
    points: Mapping[str, float | str],
    positions: NDArray[np.float64],
    style: tuple[str, str],
) -> None:
    """The lines of one method and group, with bands where there are several seeds."""
    colour, marker = style
    lines: dict[str, Any] = {
        "accuracy": {"linestyle": "-", "marker": marker, "markersize": 4},
        "best_accuracy": {"linestyle": "--", "linewidth": 1},
    }
    for measure, look in lines.items():
        of_measure = rows[rows["measure"] == measure]
        values = {
            name: one["value"].to_numpy(float) for name, one in of_measure.groupby("scenario")
        }
        here = [name in values for name in points]
        if not any(here):
            continue
        means, halves = np.array([interval(values[name]) for name in points if name in values]).T
        ax.plot(positions[here], means, color=colour, **look)
        if measure == "accuracy":
            low, high = means - halves, means + halves
            ax.fill_between(positions[here], low, high, color=colour, alpha=0.15, linewidth=0)
