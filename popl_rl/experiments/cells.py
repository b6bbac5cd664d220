"""The cells of a benchmark, and what their runs say together in tidy rows.

A *cell* is one run of ``popl-train``: a scenario of a suite, a method and a seed. All cells of a
scenario and seed see the same data, which the first of them makes.
"""

import csv
import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from popl_rl.evaluation.suite import Suite
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.manifest import digest_of_bytes, read_json, read_sealed
from popl_rl.storage import write_atomic, write_json

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "COLUMNS",
    "Cell",
    "check_folder",
    "claim",
    "collect",
    "is_finished",
    "plan",
    "results_digest",
]

COLUMNS = ["suite", "scenario", "seed", "method", "choice", "group", "measure", "value"]
"""Columns of a benchmark's ``results.csv``."""


@dataclass(frozen=True)
class Cell:
    """One run of ``popl-train``.

    Attributes:
        scenario: Name of the scenario.
        method: Name of the method.
        seed: Seed.
        overrides: Overrides of ``popl-train``, without the seed.
        source: Cell whose data and baselines it uses; None where it makes them.
        leads: Whether what it says of other methods, such as the oracle, counts for its scenario.
    """

    scenario: str
    method: str
    seed: int
    overrides: tuple[str, ...]
    source: "Cell | None" = None
    leads: bool = True

    @property
    def reward_baselines(self) -> bool:
        """Whether it is to train the further methods of its scenario, as the data's maker did."""
        return self.leads and (self.source is None or self.source.method == self.method)

    @property
    def name(self) -> str:
        """Name, and path below the folder of the cells."""
        return f"{self.scenario}/{self.method}/seed{self.seed}"

    def folder(self, run_dir: Path) -> Path:
        """Folder of the run, below the folder of the benchmark."""
        return run_dir / "cells" / self.name

    def record(self) -> dict[str, Any]:
        """What decides about the results, for ``cell.json``."""
        source = self.source
        data = None if source is None else [source.name, *source.overrides]
        return {
            "cell": self.name,
            "overrides": list(self.overrides),
            "data_of": data,
            "leads": self.leads,
        }


def plan(suite: Suite, *, seeds: int) -> list[Cell]:
    """List the cells of a suite.

    Args:
        suite: The suite.
        seeds: Number of seeds, from 0 on.

    Returns:
        Seed by seed, so that more seeds leave the places of cells as they are; and for each seed
        first the cells that make the data of others.

    Raises:
        ValueError: If ``seeds`` is below 1.
    """
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    cells: list[Cell] = []
    for seed in range(seeds):
        sources: dict[str, Cell] = {}
        followers: list[Cell] = []
        # Scenarios that make data come before those that use it.
        for scenario in sorted(suite.scenarios.values(), key=lambda one: one.data_of is not None):
            for method in scenario.methods:
                leads = method == scenario.methods[0]
                overrides = (*suite.overrides, *scenario.overrides, *suite.methods[method])
                cell = Cell(scenario.name, method, seed, overrides, leads=leads)
                if leads and scenario.data_of is None:
                    sources[scenario.name] = cell
                else:
                    source = sources[scenario.data_of or scenario.name]
                    followers.append(replace(cell, source=source))
        cells += [*sources.values(), *followers]
    return cells


def check_folder(run_dir: Path, suite: Suite) -> None:
    """Refuse a folder that a suite can neither take nor go on in; nothing is written.

    Raises:
        ValueError: If it is that of another suite, or holds something else.
    """
    kept = run_dir / "benchmark.json"
    if kept.is_file():
        cure = f"remove it if {run_dir} is of suite {suite.name!r}, or choose another run_dir"
        about = read_json(kept, cure=cure)
        other = about.get("suite") if isinstance(about, dict) else about
        if other != suite.name:
            raise ValueError(
                f"run_dir {run_dir} holds suite {other!r}, not {suite.name!r}; choose another "
                "run_dir"
            )
    # Hidden files are those that another process is just writing.
    elif run_dir.exists() and any(path.name[0] != "." for path in run_dir.iterdir()):
        raise ValueError(f"run_dir {run_dir} holds something else; choose another run_dir")


def claim(run_dir: Path, suite: Suite, cells: Sequence[Cell]) -> None:
    """Take a folder for a suite, or go on in one: writes ``benchmark.json`` and ``cells.csv``.

    Args:
        run_dir: Folder of the benchmark.
        suite: The suite.
        cells: All of its cells; ``cells.csv`` tells their numbers.

    Raises:
        ValueError: If the folder is that of another suite, or holds something else.
    """
    check_folder(run_dir, suite)
    run_dir.mkdir(parents=True, exist_ok=True)
    if not (run_dir / "benchmark.json").is_file():
        write_json(run_dir / "benchmark.json", {"suite": suite.name})
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["cell", "scenario", "method", "seed"])
    writer.writerows([i, one.scenario, one.method, one.seed] for i, one in enumerate(cells))
    numbers = run_dir / "cells.csv"
    if not numbers.is_file() or numbers.read_text(encoding="utf-8") != table.getvalue():
        write_atomic(numbers, table.getvalue())


def is_finished(cell: Cell, run_dir: Path) -> bool:
    """Whether a cell has been run to its end, and what it found is whole.

    One whose record or results are damaged is not, which is told: it is run again.

    Args:
        cell: The cell.
        run_dir: Folder of the benchmark.

    Raises:
        ValueError: If it has been run, but as something else than the suite now says.
    """
    folder = cell.folder(run_dir)
    record = folder / "cell.json"
    if not record.is_file() or not (folder / "results.csv").is_file():
        return False
    try:
        stored = read_sealed(record, cure="the cell is run again")
        if stored.get("results") not in (None, results_digest(folder)):
            raise ValueError(f"{folder / 'results.csv'} is not what it was; the cell is run again")
    except ValueError as error:
        warnings.warn(str(error), stacklevel=2)
        return False
    wanted = cell.record()
    changes = [
        f"{key} was {_without(stored.get(key), value)} and is {_without(value, stored.get(key))}"
        for key, value in wanted.items()
        if stored.get(key) != value
    ]
    if changes:
        raise ValueError(
            f"cell {cell.name} was run with other settings ({'; '.join(changes)}): delete {folder} "
            "to run it again, or choose another run_dir"
        )
    return True


def results_digest(folder: Path) -> str:
    """Digest of the results of a cell, which its record keeps."""
    return digest_of_bytes((folder / "results.csv").read_bytes())


def _without(one: Any, other: Any) -> Any:
    """What is in one list but not in the other, which may be long and much the same."""
    if isinstance(one, list) and isinstance(other, list) and set(one) != set(other):
        return [item for item in one if item not in other]
    return one


def collect(suite: Suite, cells: Sequence[Cell], run_dir: Path) -> "pd.DataFrame":
    """Put the results of finished cells together.

    The rows of what a cell trained, ``method.name`` of its configuration, get the name of its
    method in the suite. Rows of others, such as the oracle, are the same in all cells of a scenario
    and seed; those of the first method are kept. The wall time of a cell is its method's measure
    ``seconds`` of the group ``all``, missing for a cell that was resumed.

    Args:
        suite: The suite.
        cells: Cells of the suite; unfinished ones are left out.
        run_dir: Folder of the benchmark.

    Returns:
        Tidy rows ``suite, scenario, seed, method, choice, group, measure, value``.

    Raises:
        ValueError: If a cell was run as something else, see ``is_finished``, or has rows of the
            same name as another's.
    """
    import pandas as pd

    from popl_rl.evaluation.statistics import read_results

    tables = []
    for cell in cells:
        if not is_finished(cell, run_dir):
            continue
        folder = cell.folder(run_dir)
        try:
            rows = read_results(folder / "results.csv")
            trained = str(OmegaConf.select(load_run_config(folder), "method.name"))
        except (OSError, ValueError) as error:
            warnings.warn(f"cell {cell.name} is left out: {error}", stacklevel=2)
            continue
        own = rows["method"] == trained
        if not cell.leads:
            rows, own = rows[own], own[own]
        rows = rows.assign(method=rows["method"].where(~own, cell.method))
        seconds = read_sealed(folder / "cell.json", cure="run the cell again")["seconds"]
        if seconds is not None:
            timed = [(cell.method, "", "all", "seconds", seconds)]
            rows = pd.concat([rows, pd.DataFrame(timed, columns=list(rows))], ignore_index=True)
        tables.append(rows.assign(suite=suite.name, scenario=cell.scenario, seed=cell.seed))
    if not tables:
        return pd.DataFrame(columns=COLUMNS)
    results = pd.concat(tables, ignore_index=True)[COLUMNS]
    twice = results[results.duplicated(COLUMNS[:-1])]
    if len(twice):
        raise ValueError(
            f"two cells of suite {suite.name!r} have rows of method {twice['method'].iloc[0]!r} in "
            f"scenario {twice['scenario'].iloc[0]!r}; give the suite's method another name"
        )
    # Scenarios in the suite's order, whatever the order of the cells.
    places = {name: place for place, name in enumerate(suite.scenarios)}
    order = results["scenario"].map(places)
    return results.iloc[order.argsort(kind="stable")].reset_index(drop=True)
