"""What came out of a benchmark, as ``results.csv``, a report in Markdown, and pictures."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from popl_rl.evaluation.statistics import HEADLINES, headline_measure
from popl_rl.evaluation.suite import Suite
from popl_rl.experiments.benchmark_tables import (
    accuracy_table,
    axis_recoveries,
    axis_table,
    catering_table,
    recovery_table,
    turned,
)
from popl_rl.experiments.cells import Cell, is_finished
from popl_rl.experiments.markdown import markdown_table
from popl_rl.manifest import read_json
from popl_rl.plotting.benchmark_curves import catering_curves, recovery_along_axes, scenario_dots
from popl_rl.plotting.benchmark_plots import scenario_bars, sweep_panels
from popl_rl.plotting.style import save
from popl_rl.storage import write_atomic

__all__ = ["benchmark_markdown", "write_report"]

_FEW = 4  # methods whose bars can be read, and groups with rows of their own on an axis
_ACCURACY = "Accuracy in percent: of what new raters are given (of the best member)."
_WORDS = {
    "share of optimum": "(return − random) / (optimum − random) of the policy that a new rater is "
    "given, of exact returns, where the environment lists its transitions or items are chosen: 1 "
    "is the best that the group can get at all, 0 as bad as random actions.",
    "recovery": "(return − floor) / (oracle's return − floor) of the policy that a new rater is "
    "given: 1 is as good as a policy trained with the true groups, 0 as bad as random actions, or "
    "as what `evaluation.reference` names in their place.",
    "±": "half of the 95 % interval of the mean over seeds (Student's t). In brackets: the lowest "
    "seed. Bold: the best, where its interval is apart from those of all other methods.",
    "coverage": "share of groups with a recovery of at least 0.9.",
    "best in hindsight": "the lowest share of optimum, or recovery, if each group was given the "
    "best of the members that were rolled out; for recovery, chosen by one half of the episodes "
    "and evaluated by the other.",
    "gap": "what catering leaves to the best in hindsight, of the group with most.",
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
        results: Rows as of ``popl_rl.experiments.cells.collect``.
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
    text = benchmark_markdown(suite, results, about=about, missing=missing, figures=figures)
    write_atomic(run_dir / "report.md", text)


def _code_of(folder: Path) -> str:
    """What a cell was run with: the version, and the commit if it is known."""
    data = read_json(folder / "metadata.json", cure="run the cell again")
    git = data["git"]
    commit = "" if git is None else f" {git['commit'][:7]}{' and changes' * git['dirty']}"
    return f"popl_rl {data['versions']['popl_rl']}{commit}"


def benchmark_markdown(
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
        results: Rows as of ``popl_rl.experiments.cells.collect``.
        about: What was run, such as the number of seeds.
        missing: Cells that have no results, and why.
        figures: Pictures, relative to the folder of the report.

    Returns:
        Markdown: the worst group by method and scenario, what sets hold, accuracy by group, tables
        for each axis, the pictures, what scenarios and methods are, and what the words mean.
    """
    alone = [one.name for one in suite.scenarios.values() if len(one.at) != 1]
    blocks = [f"# Benchmark: suite {suite.name}"]
    blocks.append(markdown_table(["", ""], [[key, value] for key, value in about.items()]))
    if missing:
        blocks.append(f"## Missing cells: {len(missing)}")
        blocks.append("\n".join(f"- {cell}: {_line(why)}" for cell, why in missing.items()))
    head, rows = recovery_table(suite, results)
    if rows:
        blocks.append("## How well is the worst-served group served?")
        blocks.append(
            f"{_headlines(results)} of the group with the lowest, by method and scenario."
        )
        head, rows = turned(head, [row for row in rows if row[0] in alone])
        blocks.append(markdown_table(head, rows, right=len(head) - 1))
    head, rows = catering_table(suite, results[results["scenario"].isin(alone)])
    if rows:
        blocks.append("## How much does the set hold, and how much of it is found?")
        blocks.append(markdown_table(head, rows, right=len(head) - 2))
    axes = suite.axes()
    swept = {name for points in axes.values() for name in points}
    head, rows = accuracy_table(suite, results[~results["scenario"].isin(swept)])
    if rows:
        blocks.append("## How well is each group understood?")
        blocks.append(_ACCURACY)
        blocks.append(markdown_table(head, rows, right=len(head) - 2))
    for axis, points in axes.items():
        tables = _axis(suite, results, points)
        if tables:
            blocks += [f"## Axis: {axis}", *tables]
    blocks += [f"![{path.stem.replace('_', ' ')}]({quote(path.as_posix())})" for path in figures]
    blocks += _settings(suite, results)
    blocks.append("## Words")
    blocks.append("\n".join(f"- **{word}**: {meaning}" for word, meaning in _WORDS.items()))
    return "\n\n".join(blocks) + "\n"


def _headlines(results: pd.DataFrame) -> str:
    """What tables of the worst group show, and which scenarios show something else."""
    measures = {
        str(scenario): headline_measure(rows)
        for scenario, rows in results.groupby("scenario", sort=False)
    }
    found = set(measures.values())
    if len(found) == 1:
        return HEADLINES[found.pop()].capitalize()
    others = [scenario for scenario, measure in measures.items() if measure == "recovery"]
    return f"Share of optimum (recovery in {', '.join(others)})"


def _axis(suite: Suite, results: pd.DataFrame, points: Mapping[str, float | str]) -> list[str]:
    """Tables along one axis of a suite."""
    tables = []
    head, rows = axis_recoveries(suite, results, points)
    if rows:
        name = _headlines(results[results["scenario"].isin(list(points))])
        tables.append(f"{name} of the worst-served group.")
        tables.append(markdown_table(head, rows, right=len(points)))
    head, rows = axis_table(suite, results, points)
    if rows and len({group for _, group, *_ in rows}) <= _FEW:
        tables.append(_ACCURACY)
        tables.append(markdown_table(head, rows, right=len(points)))
    return tables


def _settings(suite: Suite, results: pd.DataFrame) -> list[str]:
    """What scenarios and methods are, and how long methods took."""
    scenarios = [[one.name, _code(one.overrides)] for one in suite.scenarios.values()]
    seconds = results[results["measure"] == "seconds"].groupby("method")["value"].mean()
    methods = [
        [name, _code(overrides), f"{seconds[name]:.0f}" if name in seconds else "–"]
        for name, overrides in suite.methods.items()
    ]
    return [
        "## Scenarios and methods",
        "Overrides of `popl-train`, after those of all cells: " + _code(suite.overrides),
        markdown_table(["scenario", "overrides"], scenarios),
        markdown_table(["method", "overrides", "seconds"], methods, right=1),
    ]


def _code(overrides: Sequence[str]) -> str:
    return " ".join(f"`{override}`" for override in overrides) or "none"


def _line(text: str) -> str:
    """A message of several lines on one."""
    return " ".join(text.split())
