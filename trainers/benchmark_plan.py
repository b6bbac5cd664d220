"""What a benchmark will cost, told before it starts: ``popl-benchmark plan=true``."""

import copy
import logging
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from popl_rl.config import plain
from popl_rl.experiments.cells import Cell
from popl_rl.experiments.costs import Cost, KindOfCell, calibrate, kinds_of_cells
from popl_rl.experiments.progress import Progress, without_lines
from popl_rl.trainers.benchmark_cells import Task

__all__ = ["Plan", "make_plan", "show_plan"]

_GIB = 2**30


@dataclass(frozen=True)
class Plan:
    """What the unfinished cells of a benchmark cost.

    Attributes:
        kinds: Cells that differ in their seeds alone.
        workers: Processes side by side.
        free: Bytes that are free where the benchmark's folder is or will be.
    """

    kinds: Sequence[KindOfCell]
    workers: int
    free: int

    @property
    def hours(self) -> tuple[float, float]:
        """Hours of one core, the least and the most."""
        low, high = (
            sum(kind.unfinished * kind.cost.seconds[end] for kind in self.kinds) / 3600
            for end in (0, 1)
        )
        return low, high

    @property
    def disk(self) -> float:
        """Bytes that will be written."""
        return sum(kind.unfinished * kind.cost.disk for kind in self.kinds)

    @property
    def memory(self) -> float:
        """Bytes of all workers, if the largest cells run side by side."""
        largest = max((kind.cost.memory for kind in self.kinds if kind.unfinished), default=0)
        return max(self.workers, 1) * largest


def make_plan(cells: Sequence[Cell], tasks: Sequence[Task], run_dir: Path, workers: int) -> Plan:
    """Look at what is known of each kind of cell, and calibrate the others in this process.

    Args:
        cells: All cells of the suite.
        tasks: Those that are not finished, with their configurations.
        run_dir: Folder of the benchmark, which need not exist.
        workers: Processes that would run side by side.
    """
    configs = {task.cell.overrides: task.config for task in tasks}
    kinds = len({(cell.scenario, cell.method) for cell in cells})
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    with Progress("kinds of cells", total=kinds) as progress, without_lines():
        seen = 0

        def calibrated(cell: Cell) -> Cost:
            nonlocal seen
            config = copy.deepcopy(configs[cell.overrides])
            config.seed, config.data.save = cell.seed, True
            seen += 1
            cost = calibrate(plain(config))
            progress.update(seen)
            return cost

        found = kinds_of_cells(cells, run_dir, calibrated)
    there = next(folder for folder in (run_dir, *run_dir.absolute().parents) if folder.exists())
    return Plan(found, workers, shutil.disk_usage(there).free)


def show_plan(plan: Plan) -> None:
    """Print what each kind of cell costs, and all together."""
    from rich.console import Console
    from rich.table import Column, Table

    right = {"justify": "right"}
    table = Table(
        "scenario",
        "method",
        Column("cells", **right),  # type: ignore[arg-type]
        Column("to run", **right),  # type: ignore[arg-type]
        Column("minutes each", **right),  # type: ignore[arg-type]
        Column("MiB disk", **right),  # type: ignore[arg-type]
        Column("GiB memory", **right),  # type: ignore[arg-type]
        "known from",
    )
    for kind in plan.kinds:
        low, high = (seconds / 60 for seconds in kind.cost.seconds)
        memory = f"{kind.cost.memory / _GIB:.1f}" if kind.cost.memory else "–"
        table.add_row(
            kind.scenario,
            kind.method,
            str(kind.cells),
            str(kind.unfinished),
            f"{low:.1f} to {high:.1f}",
            f"{kind.cost.disk / 2**20:.1f}",
            memory,
            kind.source,
        )
    console = Console()
    console.print(table)
    cells = sum(kind.unfinished for kind in plan.kinds)
    low, high = plan.hours
    workers = max(plan.workers, 1)
    lines = [
        f"{cells} cells to run: {low:.1f} to {high:.1f} hours of a core, "
        f"{low / workers:.1f} to {high / workers:.1f} hours with workers={plan.workers}",
        f"{plan.disk / _GIB:.1f} GiB will be written, {plan.free / _GIB:.0f} GiB are free; "
        f"{plan.memory / _GIB:.1f} GiB of memory for all workers",
        "The range is that of the runs it is known from; after a few generations alone it is from "
        "once to three times what these foretell, because the evaluation was not seen.",
    ]
    if workers > (os.cpu_count() or 1):
        lines.append(f"This machine has {os.cpu_count()} cores, fewer than there are workers.")
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False)
