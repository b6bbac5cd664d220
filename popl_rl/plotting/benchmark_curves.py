"""Figures of a benchmark with many methods: recovery by scenario, by answers, and along axes."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from popl_rl.evaluation.statistics import entries, headline_measure, interval, worst
from popl_rl.evaluation.suite import Suite
from popl_rl.plotting.benchmark_style import (
    axis_positions,
    explain_scale,
    headline_name,
    method_columns,
    method_styles,
    of_single_policies,
)
from popl_rl.plotting.style import LEGEND, PALETTE, headline, tidy

__all__ = ["catering_curves", "recovery_along_axes", "scenario_dots"]

_LOWEST, _HIGHEST = -0.5, 1.25  # recoveries beyond are drawn at the edge
_KINDS = {
    "posterior": "posterior catering",
    "information_gain": "posterior, questions chosen",
    "lexicase": "lexicase catering",
}


def scenario_dots(suite: Suite, results: pd.DataFrame) -> Figure:
    """The worst-served group's headline: a panel for each scenario, a line for each method.

    Bars of more than a few methods cannot be read any more; this can.

    Args:
        suite: The suite.
        results: Rows as of ``popl_rl.experiments.cells.collect``; of what methods are compared
            with, only a policy for everybody and the oracle are shown, and other ways to cater not
            at all.

    Raises:
        ValueError: If no recovery is known.
    """
    table = of_single_policies(suite, worst(results))
    if table.empty:
        raise ValueError("results must hold the recovery of some method in every group, got none")
    methods = _methods_of(suite, table)
    scenarios = list(table["scenario"].unique())
    styles = method_styles(suite, methods)
    columns = min(3, len(scenarios))
    lines = math.ceil(len(scenarios) / columns)
    height = lines * (0.24 * len(methods) + 0.55) + 1.1
    fig = Figure(figsize=(2.6 * columns + 2.4, height))
    headline(
        fig,
        "How well is the worst-served group served?",
        f"{explain_scale(table)}.\n"
        "Drawn from −0.5 to 1.25. Small dots are seeds, large ones\n"
        "their mean with its 95 % interval.",
    )
    axes = fig.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    low = _LOWEST if table["value"].min() < 0 else 0.0
    for ax, scenario in zip(axes.flat, scenarios, strict=False):
        for place, method in enumerate(methods):
            chosen = (table["method"] == method) & (table["scenario"] == scenario)
            values = table.loc[chosen, "value"].to_numpy(dtype=float)
            if not len(values):
                continue
            colour, marker = styles[method]
            mean, half = interval(values)
            if len(values) > 1:
                ends = np.clip([mean - half, mean + half], low, _HIGHEST)
                ax.plot(ends, [place, place], color=colour, linewidth=1.5)
                shown = np.clip(values, low, _HIGHEST)
                ax.scatter(shown, np.full(len(values), place), s=7, color=PALETTE["grey"], zorder=3)
            ax.plot(np.clip(mean, low, _HIGHEST), place, marker, color=colour, markersize=6)
        ax.axvline(1, color="black", linewidth=1, linestyle="--", zorder=0)
        ax.axvline(0, color="black", linewidth=1, zorder=0)
        ax.set_title(scenario, fontsize=10)
        ax.grid(axis="y", color="0.92")
        ax.set_axisbelow(True)
        tidy(ax)
    axes[0, 0].set_yticks(range(len(methods)), [suite.label(name) for name in methods])
    axes[0, 0].set(xlim=(low - 0.04, _HIGHEST + 0.04), ylim=(len(methods) - 0.5, -0.5))
    _switch_off(axes, len(scenarios))
    for ax in axes.flat[max(0, len(scenarios) - columns) : len(scenarios)]:
        ax.set_xlabel(headline_name(table))
        ax.tick_params(labelbottom=True)
    return fig


def catering_curves(suite: Suite, results: pd.DataFrame) -> Figure:
    """The worst-served group's headline by the number of answers that a new rater has given.

    Args:
        suite: The suite.
        results: Rows as of ``popl_rl.experiments.cells.collect``, with measures such as
            ``recovery@10`` and ``best_recovery``.

    Returns:
        A row of panels for each scenario, a panel for each kind of catering that there is (to
        questions that were drawn, or chosen by information gain), a curve for each method; to its
        right what the best member in hindsight would recover.

    Raises:
        ValueError: If there are no curves.
    """
    table = _by_answers(suite, results)
    # The best member alone is no curve, as with evaluation.curve=[].
    if not np.isfinite(table["answers"].astype(float)).any():
        raise ValueError("results must hold measures such as recovery@10, got none")
    scenarios = list(table["scenario"].unique())
    methods = _methods_of(suite, table)
    answers = sorted(table.loc[np.isfinite(table["answers"]), "answers"].unique())
    x = dict(zip(answers, np.log10(answers), strict=True))
    x[math.inf] = float(np.log10(answers[-1])) + 0.35
    styles = method_styles(suite, methods)
    kinds = {choice: kind for choice, kind in _KINDS.items() if (table["choice"] == choice).any()}
    fig = Figure(figsize=(9.2, 1.9 * len(scenarios) + 1.6 + 0.2 * len(methods) / _columns_of(9.2)))
    headline(
        fig,
        "How many answers does it take to find a new rater's policy?",
        f"{headline_name(table).capitalize()} of the worst-served group, with 95 % intervals over "
        "seeds.\nOn the right: of the best member in hindsight.",
    )
    axes = fig.subplots(len(scenarios), len(kinds), squeeze=False, sharex=True, sharey=True)
    low = max(_LOWEST, min(0.0, float(table["value"].min())))
    for row, scenario in enumerate(scenarios):
        of_scenario = table[table["scenario"] == scenario]
        for ax, (choice, kind) in zip(axes[row], kinds.items(), strict=True):
            for method in methods:
                chosen = of_scenario["method"] == method
                rows = of_scenario[chosen & of_scenario["choice"].isin([choice, "best"])]
                _curve(ax, rows, x, styles[method])
            ax.axhline(1, color="black", linewidth=1, linestyle="--", zorder=0)
            ax.set_xticks(list(x.values()), [*(f"{number:g}" for number in answers), "best"])
            ax.xaxis.set_minor_locator(NullLocator())
            tidy(ax)
            if row == 0:
                ax.set_title(kind, fontsize=10)
        axes[row, 0].set_ylabel(f"{scenario}\n{headline_name(of_scenario)}")
    axes[0, 0].set_ylim(low - 0.03, _HIGHEST)
    for ax in axes[-1]:
        ax.set_xlabel("answers of a new rater")
    _legend(fig, suite, methods, styles)
    return fig


def recovery_along_axes(suite: Suite, results: pd.DataFrame) -> Figure:
    """The worst-served group's headline along each axis of a suite, a panel for each.

    Args:
        suite: A suite with axes.
        results: Rows as of ``popl_rl.experiments.cells.collect``.

    Raises:
        ValueError: If no method has recoveries at two points of an axis.
    """
    table = of_single_policies(suite, worst(results))
    drawn = {}
    for axis, points in suite.axes().items():
        of_axis = table[table["scenario"].isin(list(points))]
        along = of_axis.groupby("method")["scenario"].transform("nunique") > 1
        if along.any():
            drawn[axis] = of_axis[along]
    if not drawn:
        raise ValueError("results must hold recoveries at two points of an axis, got none")
    methods = _methods_of(suite, pd.concat(drawn.values()))
    styles = method_styles(suite, methods)
    columns = min(3, len(drawn))
    lines = math.ceil(len(drawn) / columns)
    fig = Figure(figsize=(max(2.8 * columns + 0.6, 5.6), 2.3 * lines + 1.5))
    headline(
        fig,
        "What makes it harder to serve everybody?",
        f"{headline_name(table).capitalize()} of the worst-served group, with 95 % intervals over "
        "seeds; cut off below −0.5.",
    )
    axes = fig.subplots(lines, columns, squeeze=False, sharey=True)
    low = max(_LOWEST, min(0.0, float(table["value"].min())))
    for ax, (axis, rows) in zip(axes.flat, drawn.items(), strict=False):
        points = {n: at for n, at in suite.axes()[axis].items() if n in set(rows["scenario"])}
        places = dict(zip(points, axis_positions(list(points.values())), strict=True))
        for method in methods:
            of_method = rows[rows["method"] == method]
            _curve(ax, of_method.assign(answers=of_method["scenario"]), places, styles[method])
        ax.set_xticks(list(places.values()), [str(value) for value in points.values()])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.axhline(1, color="black", linewidth=1, linestyle="--", zorder=0)
        ax.set_xlabel(axis)
        tidy(ax)
    for row in axes:
        row[0].set_ylabel(headline_name(table))
    axes[0, 0].set_ylim(low - 0.03, _HIGHEST)
    _switch_off(axes, len(drawn))
    _legend(fig, suite, methods, styles)
    return fig


def _methods_of(suite: Suite, table: pd.DataFrame) -> list[str]:
    """Methods in the suite's order, whatever was chosen how."""
    return list(dict.fromkeys(method for method, _ in suite.ordered(entries(table))))


def _by_answers(suite: Suite, results: pd.DataFrame) -> pd.DataFrame:
    """Worst group's ``scenario, seed, method, choice, measure, answers, value`` of own methods.

    The best in hindsight is of choice ``best`` and has infinitely many answers.
    """
    tables = []
    for _, rows in results.groupby("scenario", sort=False):
        measure = headline_measure(rows)
        best = rows["measure"] == f"best_{measure}"
        parts = rows["measure"].str.extract(rf"^{measure}@(\d+)$")[0]
        answers = parts.astype(float).where(~best, math.inf)
        choice = rows["choice"].where(~best, "best")
        tables.append(rows.assign(choice=choice, answers=answers, measure=measure))
    if not tables:
        return results.assign(answers=[])
    table = pd.concat(tables)
    known = table["answers"].notna() & table["value"].notna()
    table = table[known & table["method"].isin(list(suite.methods))]
    keys = ["scenario", "seed", "method", "choice", "measure", "answers"]
    return table.groupby(keys, sort=False)["value"].min().reset_index()


def _curve(ax: Axes, rows: pd.DataFrame, places: dict[Any, float], style: tuple[str, str]) -> None:
    """One method's means with a band; what is of choice ``best`` stands apart, on a dotted line."""
    colour, marker = style
    means: dict[str, list[tuple[float, float, float]]] = {"best": [], "": []}
    for at, x in places.items():
        values = rows.loc[rows["answers"] == at]
        if len(values):
            kind = "best" if values["choice"].iloc[0] == "best" else ""
            means[kind].append((x, *interval(values["value"].to_numpy(dtype=float))))
    line: NDArray[np.float64] = np.array(means[""]).reshape(-1, 3).T
    if not line.size and not means["best"]:
        return
    x, mean, half = line
    shown = np.clip(mean, _LOWEST, _HIGHEST)
    ax.plot(x, shown, color=colour, marker=marker, markersize=4, linewidth=1.4)
    ax.fill_between(x, mean - half, mean + half, color=colour, alpha=0.12, linewidth=0)
    for place, value, _ in means["best"]:
        value = float(np.clip(value, _LOWEST, _HIGHEST))
        if len(x):
            ax.plot([x[-1], place], [shown[-1], value], color=colour, linewidth=0.8, linestyle=":")
        ax.plot(place, value, marker, color=colour, markersize=5, markerfacecolor="none")


def _columns_of(width: float) -> int:
    return max(1, int(width / 2.8))


def _switch_off(axes: NDArray[Any], used: int) -> None:
    for ax in axes.flat[used:]:
        ax.set_axis_off()


def _legend(
    fig: Figure, suite: Suite, methods: Sequence[str], styles: dict[str, tuple[str, str]]
) -> None:
    handles = [
        Line2D([], [], color=styles[name][0], marker=styles[name][1], label=suite.label(name))
        for name in methods
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=method_columns(fig), **LEGEND)
