"""Tables of a benchmark: the worst group, what sets hold, and accuracy, by scenario and method."""

import math
from collections.abc import Hashable, Mapping
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from popl_rl.evaluation.statistics import entries, headline_measure, interval, rows_of, worst
from popl_rl.evaluation.suite import Suite

__all__ = [
    "accuracy_table",
    "axis_recoveries",
    "axis_table",
    "catering_table",
    "recovery_table",
    "stands_out",
    "turned",
]

Numbers = np.ndarray[Any, np.dtype[np.float64]]
Name = TypeVar("Name", bound=Hashable)


def recovery_table(suite: Suite, results: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Lay out the worst group's headline measure, scenario by scenario.

    Args:
        suite: The suite.
        results: Rows as of ``popl_rl.experiments.cells.collect``.

    Returns:
        Names of the columns, and rows; a row for each scenario with the measure, a column for each
        method and choice. Cells are ``mean ± interval [lowest seed]``, in ``**`` where they stand
        out.
    """
    table = worst(results)
    methods = suite.ordered(entries(table))
    rows = []
    for scenario, of_scenario in table.groupby("scenario", sort=False):
        values = {
            entry: rows_of(of_scenario, *entry)["value"].to_numpy(dtype=float)
            for entry in entries(of_scenario)
        }
        best = _best(suite, values)
        seeds = max(len(numbers) for numbers in values.values())
        cells = [str(scenario)]
        for method in methods:
            text = _recovery(values[method], seeds) if method in values else "–"
            cells.append(f"**{text}**" if method == best else text)
        rows.append(cells)
    return ["scenario", *(suite.label(*entry) for entry in methods)], rows


def catering_table(suite: Suite, results: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Lay out what each method's set covers, holds, and what catering finds of it.

    Args:
        suite: The suite.
        results: Rows as of ``popl_rl.experiments.cells.collect``.

    Returns:
        Names of the columns, and rows; a row for each scenario and method with a set, with means
        over seeds and their 95 % intervals.
    """
    own = results[results["method"].isin(list(suite.methods))]
    own = own[own["choice"] != "lexicase"]
    rows = []
    for scenario in own["scenario"].unique():
        headline = headline_measure(own[own["scenario"] == scenario])
        for method in suite.methods:
            # Numbers of the set as a whole have no choice, and others are those of the headline's.
            chosen = (own["scenario"] == scenario) & (own["method"] == method)
            of_both = own[chosen & (own["group"] != "all")]
            best = _by_seed(of_both, f"best_{headline}")
            if best.empty:
                continue
            numbers = own[chosen & (own["group"] == "all")]
            coverage, effective, fair, fair_quantile = (
                numbers.loc[numbers["measure"] == name, "value"].dropna().to_numpy(dtype=float)
                for name in ("coverage", "effective", "fair_worst_rater", "fair_quantile")
            )
            gaps = [
                (best - _by_seed(of_both, measure)).groupby("seed").max().dropna().to_numpy()
                for measure in (headline, f"{headline}@10")
            ]
            cells = [coverage, best.groupby("seed").min().to_numpy(), *gaps, effective]
            last = f"{_mean(fair)} ({_mean(fair_quantile)})"
            rows.append([str(scenario), suite.label(method), *map(_mean, cells), last])
    head = ["scenario", "method", "coverage", "best in hindsight", "gap", "gap at 10 answers"]
    return [*head, "effective", "fair, worst rater (10 %)"], rows


def _by_seed(rows: pd.DataFrame, measure: str) -> pd.Series:
    """A measure by seed and group."""
    values: pd.Series = rows[rows["measure"] == measure].set_index(["seed", "group"])["value"]
    return values.dropna()


def _mean(values: Numbers) -> str:
    if not len(values):
        return "–"
    mean, half = interval(values)
    text = f"{mean:z.2f}" + ("" if math.isnan(half) else f" ± {half:.2f}")
    return text.replace("-", "−")


def turned(head: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Make rows of columns: there are more methods than scenarios. Empty ones are left out."""
    (_, *scenarios), *methods = [list(row) for row in zip(head, *rows, strict=True)]
    return ["method", *scenarios], [row for row in methods if set(row[1:]) != {"–"}]


def axis_recoveries(
    suite: Suite, results: pd.DataFrame, points: Mapping[str, float | str]
) -> tuple[list[str], list[list[str]]]:
    """A row for each method with its headline along an axis, a column for each point."""
    head, rows = recovery_table(suite, results[results["scenario"].isin(list(points))])
    if not rows:
        return head, []
    by_scenario = {row[0]: row for row in rows}
    empty = ["–"] * len(head)
    ordered = [[name, *by_scenario.get(name, empty)[1:]] for name in points]
    _, rows = turned(head, ordered)
    along = [row for row in rows if sum(cell != "–" for cell in row[1:]) > 1]
    return ["method", *map(str, points.values())], along


def stands_out(intervals: Mapping[Name, tuple[float, float]]) -> Name | None:
    """Name of the highest mean, if its interval lies apart from all others.

    Args:
        intervals: Mean and half-width by name; a half-width of NaN could be anything.

    Returns:
        The name, or None if intervals overlap or there is nothing to compare.
    """
    best = max(intervals, key=lambda name: intervals[name][0], default=None)
    if best is None or len(intervals) < 2:
        return None
    low = intervals[best][0] - intervals[best][1]
    others = [mean + half for name, (mean, half) in intervals.items() if name != best]
    # Comparisons with NaN are false.
    return best if all(low > high for high in others) else None


def _best(suite: Suite, values: Mapping[tuple[str, str], Numbers]) -> tuple[str, str] | None:
    """The method that stands out from other methods, though not from its own other catering."""
    # The oracle knows what the others have to find out.
    intervals = {
        entry: interval(numbers) for entry, numbers in values.items() if entry[0] != "oracle"
    }
    for method in suite.methods:
        own = [entry for entry in intervals if entry[0] == method]
        for entry in sorted(own, key=lambda entry: intervals[entry][0])[:-1]:
            del intervals[entry]
    return stands_out(intervals)


def _recovery(values: Numbers, seeds: int) -> str:
    mean, half = interval(values)
    text = f"{mean:z.2f}"
    if len(values) > 1:
        text += f" ± {half:.2f} [{values.min():z.2f}]"
    if len(values) < seeds:
        text += f" ({len(values)} of {seeds} seeds)"
    return text.replace("-", "−")


def accuracy_table(suite: Suite, results: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """A row for each scenario and group, a column for each method."""
    table = _accuracies(results)
    methods = suite.ordered(entries(table))
    rows = [
        [str(scenario), str(group), *(_cell(rows_of(rows, *entry)) for entry in methods)]
        for (scenario, group), rows in table.groupby(["scenario", "group"], sort=False)
    ]
    return ["scenario", "raters who want", *(suite.label(*entry) for entry in methods)], rows


def axis_table(
    suite: Suite, results: pd.DataFrame, points: Mapping[str, float | str]
) -> tuple[list[str], list[list[str]]]:
    """A row for each method and group, a column for each point of the axis."""
    table = _accuracies(results[results["scenario"].isin(list(points))])
    # Methods that do not run along the axis, but at one point that others pass, say nothing of it.
    methods = suite.ordered(
        [e for e in entries(table) if rows_of(table, *e)["scenario"].nunique() > 1]
    )
    rows = []
    for entry in methods:
        of_method = rows_of(table, *entry)
        for group in of_method["group"].unique():
            of_group = of_method[of_method["group"] == group]
            cells = [_cell(of_group[of_group["scenario"] == name]) for name in points]
            rows.append([suite.label(*entry), str(group), *cells])
    return ["method", "raters who want", *map(str, points.values())], rows


def _accuracies(results: pd.DataFrame) -> pd.DataFrame:
    chosen = results["measure"].isin(["accuracy", "best_accuracy"])
    # Random actions rank nothing, and a set has one best member, whoever chooses from it.
    nothing = results["method"] == "random"
    again = (results["choice"] == "lexicase") & (results["measure"] == "best_accuracy")
    return results[chosen & ~nothing & ~again]


def _cell(rows: pd.DataFrame) -> str:
    """Catered accuracy, and the best member's where that is something else."""
    catered, best = (
        rows.loc[rows["measure"] == measure, "value"].dropna().to_numpy(dtype=float)
        for measure in ("accuracy", "best_accuracy")
    )
    if not len(catered):
        return "–"
    text, hindsight = _percent(catered), _percent(best) if len(best) else ""
    return f"{text} ({hindsight})" if hindsight not in ("", text) else text


def _percent(values: Numbers) -> str:
    mean, half = interval(values)
    return f"{100 * mean:.1f}" + ("" if math.isnan(half) else f" ± {100 * half:.1f}")
