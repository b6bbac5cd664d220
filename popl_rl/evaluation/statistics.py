"""Statistics over groups and seeds: worst group, mean and 95 % interval."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from popl_rl.evaluation.method_names import METHODS

__all__ = ["in_order", "interval", "require_columns", "summary", "worst", "worst_recovery"]


def worst_recovery(results: pd.DataFrame) -> dict[str, float]:
    """Recovery of the group that each method serves worst.

    Args:
        results: Tidy rows ``method, group, measure, value``, averaged over repeated rows.

    Returns:
        Method -> recovery, without methods whose recovery was not measured in every group.
    """
    require_columns(results, ["method", "group", "measure", "value"])
    rows = results[results["measure"] == "recovery"]
    worst = {}
    for method in in_order(rows):
        by_group = rows[rows["method"] == method].groupby("group")["value"].mean()
        if by_group.notna().all():
            worst[method] = float(by_group.min())
    return worst


def interval(
    values: Sequence[float] | np.ndarray[Any, np.dtype[np.float64]],
) -> tuple[float, float]:
    """Mean and half-width of its 95 % interval (Student's t); the width of one value is NaN."""
    numbers = np.asarray(values, dtype=float)
    if len(numbers) < 2:
        return float(numbers.mean()), float("nan")
    error = numbers.std(ddof=1) / np.sqrt(len(numbers))
    return float(numbers.mean()), float(stats.t.ppf(0.975, len(numbers) - 1) * error)


def summary(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """What several runs (seeds) of one setting say together.

    Args:
        runs: Tidy rows ``method, group, measure, value`` of each run, by its name.

    Returns:
        A row per method that has recoveries: ``method``, ``runs``, ``worst_recovery`` (mean over
        runs of the worst group's) with half-width ``worst_recovery_ci``, ``worst_recovery_min``
        over runs, and ``accuracy_gap``, the largest distance of a group's accuracy below the
        oracle's in any run.
    """
    worst: dict[str, list[float]] = {}
    gaps: dict[str, list[float]] = {}
    for results in runs.values():
        for method, value in worst_recovery(results).items():
            worst.setdefault(method, []).append(value)
        accuracy = results[results["measure"] == "accuracy"]
        by_method = accuracy.pivot_table(index="group", columns="method", values="value")
        if "oracle" in by_method:
            for name in by_method:
                gap = float((by_method["oracle"] - by_method[name]).max())
                gaps.setdefault(str(name), []).append(gap)
    rows = []
    for method, values in worst.items():
        mean, half = interval(values)
        gap = max(gaps.get(method, [float("nan")]))
        rows.append((method, len(values), mean, half, min(values), gap))
    columns = ["method", "runs", "worst_recovery", "worst_recovery_ci", "worst_recovery_min"]
    return pd.DataFrame(rows, columns=[*columns, "accuracy_gap"])


def in_order(results: pd.DataFrame) -> list[str]:
    found = list(results["method"].unique())
    return [m for m in METHODS if m in found] + [m for m in found if m not in METHODS]


def worst(results: pd.DataFrame) -> pd.DataFrame:
    """Recovery of the group that each method serves worst, run by run.

    Args:
        results: Rows as of :func:`collect`.

    Returns:
        Rows ``scenario, seed, method, value``, without methods whose recovery is unknown in a
        group, and without the oracle and random actions, which have 1 and 0.
    """
    rows = [
        (scenario, seed, method, value)
        for (scenario, seed), run in results.groupby(["scenario", "seed"], sort=False)
        for method, value in worst_recovery(run).items()
        if method not in ("oracle", "random")
    ]
    return pd.DataFrame(rows, columns=["scenario", "seed", "method", "value"])


def require_columns(table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Raise ValueError, naming what is missing, unless a table has these columns."""
    missing = [column for column in columns if column not in table]
    if missing:
        raise ValueError(f"the table must have the columns {columns}, {missing} are missing")
