"""Rows of benchmarks as the tables of README files read them, and how numbers are written there."""

from collections.abc import Iterable, Sequence
from typing import Literal, cast

import pandas as pd

from popl_rl.evaluation.statistics import interval, require_columns
from popl_rl.experiments.cells import COLUMNS

__all__ = [
    "Entry",
    "Over",
    "column_pairs",
    "difference",
    "difference_text",
    "number_text",
    "rows_of_methods",
    "values_by_seed",
]

Entry = tuple[str, str]
"""A method and how the hypothesis was chosen from what it offers."""

Over = Literal["worst", "mean", "all"]
"""Of which group: the one served worst, the mean over groups, or all groups together."""


def rows_of_methods(results: pd.DataFrame, suite: str, methods: Iterable[Entry]) -> pd.DataFrame:
    """Rows of a suite, and of methods by their names and choices.

    Args:
        results: Rows with the columns ``COLUMNS``.
        suite: Name of the suite.
        methods: Methods and choices.

    Returns:
        Those rows; an empty choice is an empty string, not NaN.

    Raises:
        ValueError: If ``results`` lacks a column.
    """
    require_columns(results, COLUMNS)
    # Without a single choice, pandas reads the column as numbers.
    choice = results["choice"].astype(object).where(results["choice"].notna(), "")
    rows = results.assign(choice=choice)
    named = column_pairs(rows, "method", "choice").isin(list(methods))
    return rows[(rows["suite"] == suite) & named]


def column_pairs(rows: pd.DataFrame, one: str, other: str) -> pd.Series:
    """What two columns hold, as a column of pairs."""
    return pd.Series(list(zip(rows[one], rows[other], strict=True)), rows.index)


def values_by_seed(rows: pd.DataFrame, over: Over) -> dict[tuple[Entry, str], dict[int, float]]:
    """One value for each method, scenario and seed.

    Args:
        rows: Rows of one measure in each scenario, one for each group.
        over: The lowest of the groups, or their mean.

    Returns:
        ``((method, choice), scenario)`` -> seed -> value. A seed in which the value of a group is
        unknown, as a recovery is whose oracle is poor, has none: the others would hide it.
    """
    grouped = rows.groupby(["method", "choice", "scenario", "seed"])["value"]
    each = (grouped.min() if over == "worst" else grouped.mean())[~grouped.agg(_has_unknown)]
    values: dict[tuple[Entry, str], dict[int, float]] = {}
    for key, value in cast("dict[tuple[str, str, str, int], float]", each.to_dict()).items():
        method, choice, scenario, seed = key
        values.setdefault(((method, choice), scenario), {})[seed] = value
    return values


def _has_unknown(values: pd.Series) -> bool:
    return bool(values.isna().any())


def difference(one: dict[int, float], other: dict[int, float]) -> list[float]:
    """``one`` minus ``other`` on the seeds that both have."""
    return [one[seed] - other[seed] for seed in sorted(one.keys() & other.keys())]


def difference_text(values: Sequence[float]) -> str:
    """Mean of differences ± half of its 95 % interval; – without any."""
    if not values:
        return "–"
    mean, half = interval(values)
    return number_text(mean) + (f" ± {half:.2f}" if len(values) > 1 else "")


def number_text(value: float) -> str:
    """A number with two decimals and a minus sign."""
    # Rounded first, so that nothing is written as a negative zero.
    return f"{round(value, 2) + 0.0:.2f}".replace("-", "−")
