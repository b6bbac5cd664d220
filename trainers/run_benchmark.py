"""Compare methods over scenarios and seeds, on the same data: ``popl-benchmark``.

popl-benchmark suite=two_doors                     # goes on where it was stopped
popl-benchmark suite=smoke seeds=2 workers=4
popl-benchmark suite=my_suite.yaml run_dir=runs/mine
popl-benchmark suite=many plan=true                # what it will cost: cells, hours, gigabytes
popl-benchmark suite=smoke cell=1                  # one cell alone; collect later without cell=
popl-benchmark -m suite=two_doors 'cell=range(0,60)' hydra/launcher=joblib
"""

import sys
import time
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from rich.console import Console

from popl_rl.evaluation.suite import Suite
from popl_rl.experiments.cells import Cell, check_folder, claim, collect, is_finished, plan
from popl_rl.experiments.jobs import Job, run_jobs
from popl_rl.experiments.suites import load_suite
from popl_rl.interruption import Terminated, importing
from popl_rl.trainers.benchmark_cells import make_tasks, run_task
from popl_rl.trainers.command import register_schemas, run_command

if TYPE_CHECKING:
    import pandas as pd

    from popl_rl.trainers.benchmark_plan import Plan


@dataclass
class BenchmarkConfig:
    """What popl-benchmark does."""

    suite: str = MISSING  # name of a suite in configs/suites, or a YAML file
    seeds: int | None = None  # seeds 0, 1, ... of every scenario and method; the suite's if null
    workers: int = 2  # processes, each of which uses one core; 0 for none but this
    run_dir: str | None = None  # folder of the benchmark; runs/benchmark-<suite> if null
    cell: int | None = None  # run this one alone; numbers are in cells.csv
    plan: bool = False  # say what it will cost, and run nothing


@dataclass(frozen=True)
class Result:
    """What a benchmark leaves behind, and what went wrong by name of the cell."""

    run_dir: Path
    suite: Suite
    results: "pd.DataFrame"
    failures: dict[str, str]


def run(config: BenchmarkConfig) -> Result:
    """Run the cells that are not finished, and put together what all of them say."""
    # 1. What there is to do.
    suite, cells, run_dir = _begun(config)
    wanted = cells if config.cell is None else _one(cells, config.cell)
    check_folder(run_dir, suite)  # a wrong folder is told before wrong settings
    unfinished = [cell for cell in wanted if not is_finished(cell, run_dir)]
    tasks = make_tasks(unfinished, run_dir)
    claim(run_dir, suite, cells)  # after the settings: wrong ones leave no folder behind
    # Imported late, so that a wrong setting is told at once.
    with importing():
        from popl_rl.experiments.benchmark_report import write_report
        from popl_rl.experiments.progress import Progress

    # 2. Doing it.
    jobs = [Job(t.cell.name, t, t.cell.source.name if t.cell.source else None) for t in tasks]
    before = ended = len(wanted) - len(jobs)
    failed, started = 0, time.monotonic()
    # What a cell run in this process prints goes to its log; the bar stays on the screen.
    screen = Console(file=sys.stderr)
    with Progress("cells", total=len(wanted), completed=ended, console=screen) as progress:

        def on_done(_name: str, error: str | None) -> None:
            nonlocal ended, failed
            ended, failed = ended + 1, failed + (error is not None)
            minutes = (time.monotonic() - started) / 60 / (ended - before) * (len(wanted) - ended)
            progress.update(ended, failed=failed, minutes_left=minutes)

        workers = config.workers if config.cell is None else 0
        failures = run_jobs(jobs, run_task, workers=workers, on_done=on_done)

    # 3. What came out.
    results = collect(suite, wanted, run_dir)
    if config.cell is None:
        write_report(run_dir, suite, cells, results, failures)
    return Result(run_dir, suite, results, failures)


def foretell(config: BenchmarkConfig) -> "Plan":
    """What the cells that are not finished will cost."""
    _, cells, run_dir = _begun(config)
    tasks = make_tasks([cell for cell in cells if not is_finished(cell, run_dir)], run_dir)
    with importing():
        from popl_rl.trainers.benchmark_plan import make_plan
    return make_plan(cells, tasks, run_dir, config.workers)


def _begun(config: BenchmarkConfig) -> tuple[Suite, list[Cell], Path]:
    """The suite, its cells and the folder."""
    if config.workers < 0:
        raise ValueError(
            f"workers must be at least 0, got {config.workers}; 0 works in one process"
        )
    suite = load_suite(config.suite, folder=files("popl_rl.configs.suites"))
    cells = plan(suite, seeds=suite.seeds if config.seeds is None else config.seeds)
    return suite, cells, Path(config.run_dir or f"runs/benchmark-{suite.name}")


def _one(cells: list[Cell], index: int) -> list[Cell]:
    """A cell, after the one that makes its data."""
    if not 0 <= index < len(cells):
        raise ValueError(f"cell must be from 0 to {len(cells) - 1}, got {index}; see cells.csv")
    cell = cells[index]
    return [cell] if cell.source is None else [cell.source, cell]


def show(result: Result) -> None:
    """Print the table and where everything is."""
    from rich.table import Column, Table
    from rich.text import Text

    from popl_rl.evaluation.method_names import drawn_references
    from popl_rl.evaluation.statistics import HEADLINES, headline_measure
    from popl_rl.experiments.benchmark_tables import recovery_table

    console = Console()
    suite = result.suite
    (_, *methods), rows = recovery_table(suite, result.results)
    shown = [suite.label(name) for name in (*suite.methods, *drawn_references())]
    table = Table(
        "scenario",
        "method",
        Column(
            f"{HEADLINES[headline_measure(result.results)]} ± 95 % [lowest seed]", justify="right"
        ),
        title="How well is the worst-served group served?",
    )
    for scenario, *cells in rows:
        table.add_section()
        for method, cell in zip(methods, cells, strict=True):
            if method in shown and cell != "–":
                table.add_row(scenario, method, Text(cell.strip("*"), "bold" * ("**" in cell)))
    if rows:
        console.print(table)
    console.print(f"everything is in {result.run_dir}", soft_wrap=True)


ConfigStore.instance().store(name="benchmark_schema", node=BenchmarkConfig)
register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="benchmark")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    if cfg.plan:
        from popl_rl.trainers.benchmark_plan import show_plan

        show_plan(foretell(cfg))
        return
    try:
        result = run(cfg)
    except (KeyboardInterrupt, Terminated) as stop:
        stop.__notes__ = ["the same command goes on where this stopped"]
        raise
    show(result)
    if result.failures:
        listed = "\n  ".join(f"{cell}: {error}" for cell, error in result.failures.items())
        raise ValueError(f"{len(result.failures)} cells failed:\n  {listed}")


def cli() -> None:
    """Console command ``popl-benchmark``."""
    run_command(main, BenchmarkConfig)


if __name__ == "__main__":
    cli()
