"""What came out of a benchmark, as ``results.csv``, tables in Markdown, and pictures."""

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from popl_rl.evaluation.statistics import interval, worst
from popl_rl.evaluation.suite import Suite
from popl_rl.experiments.cells import Cell, is_finished
from popl_rl.experiments.markdown import markdown_table
from popl_rl.plotting.benchmark_curves import catering_curves, recovery_along_axes, scenario_dots
from popl_rl.plotting.benchmark_plots import scenario_bars, sweep_panels
from popl_rl.plotting.style import save
from popl_rl.storage import write_atomic

__all__ = ["markdown", "recovery_table", "stands_out", "write_report"]

_FEW = 4  # methods whose bars can be read, and groups with rows of their own on an axis
Numbers = np.ndarray[Any, np.dtype[np.float64]]
_WORDS = {
    "recovery": "(return − floor) / (oracle's return − floor) of the policy that a new rater is "
    "given: 1 is as good as a policy trained with the true groups, 0 as bad as random actions, or "
    "as what `evaluation.reference` names in their place.",
    "±": "half of the 95 % interval of the mean over seeds (Student's t). In brackets: the lowest "
    "seed. Bold: the best, where its interval is apart from those of all other methods.",
    "coverage": "share of groups with a recovery of at least 0.9.",
    "best in hindsight": "the lowest recovery if each group was given the best of the members "
    "that were rolled out; chosen by one half of the episodes and judged by the other.",
    "gap": "what catering leaves to the best in hindsight, in recovery, of the group with most.",
    "effective": "number of clearly different members (order 2, similarity-sensitive).",
    "fair, worst rater (10 %)": "accuracy of the one policy that a panel of new raters makes the "
    "fair choice, for the worst rater (and the 10 % quantile) of another panel.",
    "accuracy": "share of held-out pairs, in percent, that the policy given to new raters of the "
    "group ranks as the group does; in parentheses, that of the member that suits the group best, "
    "as only hindsight can tell.",
    "seconds": "wall time of a cell, mean over its finished runs. The first method of a scenario "
    "also collects the data and trains what methods are compared with.",
}


def write_report(
    run_dir: Path,
    suite: Suite,
    cells: Sequence[Cell],
    results: pd.DataFrame,
    failures: Mapping[str, str],
) -> None:
    """Write ``results.csv``, ``report.md`` and ``figures`` of a benchmark.

    Args:
        run_dir: Folder of the benchmark.
        suite: The suite.
        cells: All cells that there should be.
        results: Rows as of :func:`popl_rl.experiments.cells.collect`.
        failures: What went wrong, by name of the cell.
    """
    write_atomic(run_dir / "results.csv", results.to_csv(index=False))
    folder = run_dir / "figures"
    folder.mkdir(exist_ok=True)
    # Scenarios on a single axis are told apart in its panel, where bars would be too many.
    alone = [one.name for one in suite.scenarios.values() if len(one.at) != 1]
    apart = results[results["scenario"].isin(alone)]
    drawings = {
        "recovery": (scenario_bars if len(suite.methods) <= _FEW else scenario_dots, apart),
        "catering": (catering_curves, apart),
        "axes": (recovery_along_axes, results),
    }
    ranked = results[results["measure"] == "accuracy"]
    if ranked.loc[~ranked["scenario"].isin(alone), "group"].nunique() <= _FEW:
        drawings["sweeps"] = (sweep_panels, results)
    figures = []
    for name, (draw, rows) in drawings.items():
        path = folder / f"{name}.png"
        path.unlink(missing_ok=True)
        with contextlib.suppress(ValueError):  # there is nothing of the kind to draw
            save(draw(suite, rows), path)
            figures.append(path.relative_to(run_dir))
    finished = [cell for cell in cells if is_finished(cell, run_dir)]
    names = {cell.name for cell in finished}
    missing = {c.name: failures.get(c.name, "not run yet") for c in cells if c.name not in names}
    about = {
        "cells": f"{len(finished)} of {len(cells)}",
        "seeds": max(cell.seed for cell in cells) + 1,
        "code": ", ".join(sorted({_code_of(cell.folder(run_dir)) for cell in finished})) or "–",
    }
    text = markdown(suite, results, about=about, missing=missing, figures=figures)
    write_atomic(run_dir / "report.md", text)


def _code_of(folder: Path) -> str:
    """What a cell was run with: the version, and the commit if it is known."""
    data = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    git = data["git"]
    commit = "" if git is None else f" {git['commit'][:7]}{' and changes' * git['dirty']}"
    return f"popl_rl {data['versions']['popl_rl']}{commit}"


def markdown(
    suite: Suite,
    results: pd.DataFrame,
    *,
    about: Mapping[str, Any],
    missing: Mapping[str, str],
    figures: Sequence[Path],
) -> str:
    """Write the text of a benchmark's report.

    Args:
        suite: The suite.
        results: Rows as of :func:`popl_rl.experiments.cells.collect`.
        about: What was run, such as the number of seeds.
        missing: Cells that have no results, and why.
        figures: Pictures, relative to the folder of the report.

    Returns:
        Markdown: recovery by method and scenario, what sets hold, accuracy by group, tables for
        each axis, the pictures, what scenarios and methods are, and what the words mean.
    """
    blocks = [f"# Benchmark: suite {suite.name}"]
    blocks.append(markdown_table(["", ""], [[key, value] for key, value in about.items()]))
    if missing:
        blocks.append(f"## Missing cells: {len(missing)}")
        blocks.append("\n".join(f"- {cell}: {_line(why)}" for cell, why in missing.items()))
    alone = [one.name for one in suite.scenarios.values() if len(one.at) != 1]
    head, rows = recovery_table(suite, results)
    if rows:
        blocks.append("## How well is the worst-served group served?")
        blocks.append("Recovery of the group with the lowest, by method and scenario.")
        head, rows = _turned(head, [row for row in rows if row[0] in alone])
        blocks.append(markdown_table(head, rows, right=len(head) - 1))
    head, rows = catering_table(suite, results[results["scenario"].isin(alone)])
    if rows:
        blocks.append("## How much does the set hold, and how much of it is found?")
        blocks.append(markdown_table(head, rows, right=len(head) - 2))
    axes = suite.axes()
    swept = {name for points in axes.values() for name in points}
    head, rows = _accuracy_table(suite, results[~results["scenario"].isin(swept)])
    if rows:
        blocks.append("## How well is each group understood?")
        blocks.append("Accuracy in percent: of what new raters are given (of the best member).")
        blocks.append(markdown_table(head, rows, right=len(head) - 2))
    for axis, points in axes.items():
        tables = []
        head, rows = _axis_recoveries(suite, results, points)
        if rows:
            tables.append("Recovery of the worst-served group.")
            tables.append(markdown_table(head, rows, right=len(points)))
        head, rows = _axis_table(suite, results, points)
        if rows and len({group for _, group, *_ in rows}) <= _FEW:
            tables.append("Accuracy in percent: of what new raters are given (of the best member).")
            tables.append(markdown_table(head, rows, right=len(points)))
        if tables:
            blocks += [f"## Axis: {axis}", *tables]
    blocks += [f"![{path.stem.replace('_', ' ')}]({quote(path.as_posix())})" for path in figures]
    blocks.append("## Scenarios and methods")
    blocks.append("Overrides of `popl-train`, after those of all cells: " + _code(suite.overrides))
    scenarios = [[one.name, _code(one.overrides)] for one in suite.scenarios.values()]
    blocks.append(markdown_table(["scenario", "overrides"], scenarios))
    seconds = results[results["measure"] == "seconds"].groupby("method")["value"].mean()
    methods = [
        [name, _code(overrides), f"{seconds[name]:.0f}" if name in seconds else "–"]
        for name, overrides in suite.methods.items()
    ]
    blocks.append(markdown_table(["method", "overrides", "seconds"], methods, right=1))
    blocks.append("## Words")
    blocks.append("\n".join(f"- **{word}**: {meaning}" for word, meaning in _WORDS.items()))
    return "\n\n".join(blocks) + "\n"


def recovery_table(suite: Suite, results: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Lay out the worst group's recovery, scenario by scenario.

    Args:
        suite: The suite.
        results: Rows as of :func:`popl_rl.experiments.cells.collect`.

    Returns:
        Names of the columns, and rows; a row for each scenario with a recovery, a column for each
        method. Cells are ``mean ± interval [lowest seed]``, in ``**`` where they stand out.
    """
    table = worst(results)
    methods = suite.ordered(list(table["method"].unique()))
    rows = []
    for scenario, of_scenario in table.groupby("scenario", sort=False):
        values = {
            str(name): rows["value"].to_numpy(dtype=float)
            for name, rows in of_scenario.groupby("method")
        }
        best = _best(suite, values)
        seeds = max(len(numbers) for numbers in values.values())
        cells = [str(scenario)]
        for method in methods:
            text = _recovery(values[method], seeds) if method in values else "–"
            cells.append(f"**{text}**" if method == best else text)
        rows.append(cells)
    return ["scenario", *map(suite.label, methods)], rows


def catering_table(suite: Suite, results: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Lay out what each method's set covers, holds, and what catering finds of it.

    Args:
        suite: The suite.
        results: Rows as of :func:`popl_rl.experiments.cells.collect`.

    Returns:
        Names of the columns, and rows; a row for each scenario and method with a set, with means
        over seeds and their 95 % intervals.
    """
    own = results[results["method"].isin(list(suite.methods))]
    whole = own[own["group"] == "all"]
    rows = []
    for scenario in own["scenario"].unique():
        for method in suite.methods:
            chosen = (own["scenario"] == scenario) & (own["method"] == method)
            of_both = own[chosen & (own["group"] != "all")]
            best = _by_seed(of_both, "best_recovery")
            if best.empty:
                continue
            numbers = whole[(whole["scenario"] == scenario) & (whole["method"] == method)]
            coverage, effective, fair, fair_quantile = (
                numbers.loc[numbers["measure"] == name, "value"].dropna().to_numpy(dtype=float)
                for name in ("coverage", "effective", "fair_worst_rater", "fair_quantile")
            )
            gaps = [
                (best - _by_seed(of_both, measure)).groupby("seed").max().dropna().to_numpy()
                for measure in ("recovery", "recovery@10")
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


def _turned(head: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Make rows of columns: there are more methods than scenarios. Empty ones are left out."""
    turned = [list(row) for row in zip(head, *rows, strict=True)]
    (_, *scenarios), *methods = turned
    return ["method", *scenarios], [row for row in methods if set(row[1:]) != {"–"}]


def _axis_recoveries(
    suite: Suite, results: pd.DataFrame, points: Mapping[str, float | str]
) -> tuple[list[str], list[list[str]]]:
    """A row for each method that has recoveries along an axis, a column for each point."""
    head, rows = recovery_table(suite, results[results["scenario"].isin(list(points))])
    if not rows:
        return head, []
    by_scenario = {row[0]: row for row in rows}
    empty = ["–"] * len(head)
    ordered = [[name, *by_scenario.get(name, empty)[1:]] for name in points]
    _, turned = _turned(head, ordered)
    along = [row for row in turned if sum(cell != "–" for cell in row[1:]) > 1]
    return ["method", *map(str, points.values())], along


def stands_out(intervals: Mapping[str, tuple[float, float]]) -> str | None:
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


def _best(suite: Suite, values: Mapping[str, Numbers]) -> str | None:
    """The method that stands out from other methods, though not from its own other catering."""
    intervals = {name: interval(numbers) for name, numbers in values.items()}
    for method in suite.methods:
        other = f"{method}_lexicase"
        if method in intervals and other in intervals:
            worse = min(method, other, key=lambda name: intervals[name][0])
            del intervals[worse]
    return stands_out(intervals)


def _recovery(values: Numbers, seeds: int) -> str:
    mean, half = interval(values)
    text = f"{mean:z.2f}"
    if len(values) > 1:
        text += f" ± {half:.2f} [{values.min():z.2f}]"
    if len(values) < seeds:
        text += f" ({len(values)} of {seeds} seeds)"
    return text.replace("-", "−")


def _accuracy_table(suite: Suite, results: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """A row for each scenario and group, a column for each method."""
    table = _accuracies(results)
    methods = suite.ordered(list(table["method"].unique()))
    rows = [
        [str(scenario), str(group), *(_cell(rows[rows["method"] == name]) for name in methods)]
        for (scenario, group), rows in table.groupby(["scenario", "group"], sort=False)
    ]
    return ["scenario", "raters who want", *map(suite.label, methods)], rows


def _axis_table(
    suite: Suite, results: pd.DataFrame, points: Mapping[str, float | str]
) -> tuple[list[str], list[list[str]]]:
    """A row for each method and group, a column for each point of the axis."""
    table = _accuracies(results[results["scenario"].isin(list(points))])
    # Methods that do not run along the axis, but at one point that others pass, say nothing of it.
    along = table.groupby("method")["scenario"].nunique()
    methods = suite.ordered([str(name) for name, number in along.items() if number > 1])
    rows = []
    for method in methods:
        of_method = table[table["method"] == method]
        for group in of_method["group"].unique():
            of_group = of_method[of_method["group"] == group]
            cells = [_cell(of_group[of_group["scenario"] == name]) for name in points]
            rows.append([suite.label(method), str(group), *cells])
    return ["method", "raters who want", *map(str, points.values())], rows


def _accuracies(results: pd.DataFrame) -> pd.DataFrame:
    chosen = results["measure"].isin(["accuracy", "best_accuracy"])
    # Random actions rank nothing, and a set has one best member, whoever chooses from it.
    nothing = results["method"] == "random"
    again = results["method"].str.endswith("_lexicase") & (results["measure"] == "best_accuracy")
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


def _code(overrides: Sequence[str]) -> str:
    return " ".join(f"`{override}`" for override in overrides) or "none"


def _line(text: str) -> str:
    """A message of several lines on one."""
    return " ".join(text.split())
