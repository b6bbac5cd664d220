"""Statistics over groups and seeds: headline measure, worst group, mean and 95 % interval."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from popl_rl.evaluation.method_names import METHODS, sort_key

__all__ = [
    "HEADLINES",
    "RESULT_COLUMNS",
    "differs_from_zero",
    "entries",
    "headline_measure",
    "interval",
    "read_results",
    "require_columns",
    "rows_of",
    "summary",
    "worst",
    "worst_group",
]

RESULT_COLUMNS = ["method", "choice", "group", "measure", "value"]
"""Columns of a run's ``results.csv``. ``choice`` tells how the hypothesis was chosen from what the
method offers, such as ``posterior`` or ``lexicase``; it is empty where there is nothing to choose,
and for measures of a set as a whole."""

HEADLINES = {"share_of_optimum": "share of optimum", "recovery": "recovery"}
"""Measures that tell how well a group is served, the preferred one first, and their names."""


def read_results(path: Path) -> pd.DataFrame:
    """Read ``results.csv`` of a run or of a benchmark.

    Args:
        path: The file.

    Returns:
        Its rows; an empty choice is an empty string, not NaN.

    Raises:
        ValueError: If it is cut off, or no such table.
    """
    cure = "finish the run again with resume=<its folder>, or restore the file"
    try:
        text = path.read_text(encoding="utf-8")
        table = pd.read_csv(io.StringIO(text), dtype={"choice": "str"})
        missing = {"method", "measure", "value"} - set(table)
        if missing or not text.endswith("\n") or not pd.api.types.is_numeric_dtype(table["value"]):
            raise ValueError("it is cut off, or lacks columns")
    except (ValueError, pd.errors.ParserError) as error:
        raise ValueError(f"{path} is no whole table of results ({error}); {cure}") from error
    # pandas reads empty text as NaN, which equals nothing and is left out of groups.
    return table.fillna({"choice": ""}) if "choice" in table else table


def headline_measure(results: pd.DataFrame) -> str:
    """Measure that tells best how well groups are served.

    Args:
        results: Rows with columns ``measure`` and ``value``.

    Returns:
        ``share_of_optimum`` where it is known (environments with a transition table), and
        ``recovery`` elsewhere.
    """
    known = results["measure"].eq("share_of_optimum") & results["value"].notna()
    return "share_of_optimum" if known.any() else "recovery"


def entries(results: pd.DataFrame) -> list[tuple[str, str]]:
    """Methods and choices of a results table that are shown, in the order to show them in."""
    hidden = [name for name, method in METHODS.items() if not method.is_shown]
    shown = results.loc[~results["method"].isin(hidden), ["method", "choice"]]
    found = shown.drop_duplicates().itertuples(index=False, name=None)
    # sorted() is stable: what is not listed keeps its order.
    return sorted(((str(m), str(c)) for m, c in found), key=lambda entry: sort_key(*entry))


def rows_of(table: pd.DataFrame, method: str, choice: str) -> pd.DataFrame:
    """Rows of one method and choice."""
    return table[(table["method"] == method) & (table["choice"] == choice)]


def worst_group(results: pd.DataFrame, measure: str = "recovery") -> dict[tuple[str, str], float]:
    """Value of a measure for the group that each method and choice serves worst.

    Args:
        results: Tidy rows ``method, choice, group, measure, value``, averaged over repeated rows.
        measure: The measure.

    Returns:
        ``(method, choice)`` -> value, without those that were not measured in every group.

    Raises:
        ValueError: If a column is missing.
    """
    require_columns(results, RESULT_COLUMNS)
    rows = results[results["measure"] == measure]
    lowest = {}
    for entry in entries(rows):
        by_group = rows_of(rows, *entry).groupby("group")["value"].mean()
        if by_group.notna().all():
            lowest[entry] = float(by_group.min())
    return lowest


def interval(
    values: Sequence[float] | np.ndarray[Any, np.dtype[np.float64]],
) -> tuple[float, float]:
    """Mean and half-width of its 95 % interval (Student's t); the width of one value is NaN."""
    numbers = np.asarray(values, dtype=float)
    if len(numbers) < 2:
        return float(numbers.mean()), float("nan")
    error = numbers.std(ddof=1) / np.sqrt(len(numbers))
    return float(numbers.mean()), float(stats.t.ppf(0.975, len(numbers) - 1) * error)


def differs_from_zero(samples: Sequence[Sequence[float]], *, level: float = 0.05) -> list[bool]:
    """Which means differ from 0, judged together: t-tests with the step-down of Holm (1979).

    Args:
        samples: Values of each; fewer than two tell nothing, and are not counted.
        level: Chance of any error among all.
    """
    chance = [
        float(stats.ttest_1samp(one, 0.0).pvalue) if len(one) > 1 and np.ptp(one) > 0 else np.nan
        for one in samples
    ]
    order = [index for index in np.argsort(chance) if not np.isnan(chance[index])]
    sure = [False] * len(samples)
    for rank, index in enumerate(order):
        if chance[index] > level / (len(order) - rank):
            break
        sure[index] = True
    return sure


def summary(runs: Mapping[str, pd.DataFrame], *, measure: str = "recovery") -> pd.DataFrame:
    """What several runs (seeds) of one setting say together.

    Args:
        runs: Tidy rows ``method, choice, group, measure, value`` of each run, by its name.
        measure: What the worst group is looked for in, see ``headline_measure``.

    Returns:
        A row for each method and choice with this measure: ``method``, ``choice``, ``runs``,
        ``worst_<measure>`` (mean over runs of the worst group's) with half-width
        ``worst_<measure>_ci``, ``worst_<measure>_min`` over runs, and ``accuracy_gap``, the largest
        distance of a group's accuracy below the oracle's in any run.
    """
    lowest: dict[tuple[str, str], list[float]] = {}
    gaps: dict[tuple[str, str], list[float]] = {}
    for results in runs.values():
        for entry, value in worst_group(results, measure).items():
            lowest.setdefault(entry, []).append(value)
        accuracy = results[results["measure"] == "accuracy"]
        by_entry = {
            entry: rows_of(accuracy, *entry).groupby("group")["value"].mean()
            for entry in entries(accuracy)
        }
        oracle = by_entry.get(("oracle", ""))
        if oracle is not None:
            for entry, values in by_entry.items():
                gaps.setdefault(entry, []).append(float((oracle - values).max()))
    rows = []
    for entry, numbers in lowest.items():
        mean, half = interval(numbers)
        gap = max(gaps.get(entry, [float("nan")]))
        rows.append((*entry, len(numbers), mean, half, min(numbers), gap))
    name = f"worst_{measure}"
    columns = ["method", "choice", "runs", name, f"{name}_ci", f"{name}_min", "accuracy_gap"]
    return pd.DataFrame(rows, columns=columns)


def worst(results: pd.DataFrame) -> pd.DataFrame:
    """Headline measure of the group that each method serves worst, run by run.

    Args:
        results: Rows ``scenario, seed, method, choice, group, measure, value`` of a benchmark.

    Returns:
        Rows ``scenario, seed, method, choice, measure, value``, where ``measure`` is the headline
        of the scenario. Left out are methods whose value is unknown in a group, and what is so by
        definition: random actions, of which both measures are 0, and the oracle's recovery of 1.
    """
    rows = []
    for scenario, of_scenario in results.groupby("scenario", sort=False):
        measure = headline_measure(of_scenario)
        trivial = ("random",) if measure == "share_of_optimum" else ("random", "oracle")
        for seed, run in of_scenario.groupby("seed", sort=False):
            for (method, choice), value in worst_group(run, measure).items():
                if method not in trivial:
                    rows.append((scenario, seed, method, choice, measure, value))
    columns = ["scenario", "seed", "method", "choice", "measure", "value"]
    return pd.DataFrame(rows, columns=columns)


def require_columns(table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Raise ValueError, naming what is missing, unless a table has these columns."""
    missing = [column for column in columns if column not in table]
    if missing:
        raise ValueError(
            f"the table must have the columns {[*columns]}, {missing} are missing; tables of older "
            "versions must be made again with popl-train or popl-evaluate"
        )
