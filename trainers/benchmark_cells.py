"""One cell of a benchmark: trained, resumed, or left as it is when it is finished."""

import contextlib
import copy
import logging
import shutil
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popl_rl.config import plain, validate
from popl_rl.experiments.cells import Cell, is_finished, results_digest
from popl_rl.experiments.costs import peak_memory, size_of
from popl_rl.experiments.progress import without_lines
from popl_rl.experiments.run_manifest import config_text
from popl_rl.locks import HeldError, locked
from popl_rl.manifest import sealed
from popl_rl.storage import write_json
from popl_rl.trainers import train_popl
from popl_rl.trainers.command import USER_ERRORS
from popl_rl.trainers.composing import compose_settings

# One core for each cell; a benchmark's own report takes the place of a log of each.
_ALWAYS = ("logger=csv", "threads=1")


@dataclass(frozen=True)
class Task:
    """What a worker is given: a cell, the benchmark's folder, and the cell's configuration."""

    cell: Cell
    run_dir: Path
    config: Any


def make_tasks(cells: Sequence[Cell], run_dir: Path) -> list[Task]:
    """Compose the configuration of every cell, so that mistakes are found before anything runs.

    Raises:
        ValueError: If a configuration does not compose or is not valid, with a name of its cell.
    """
    configs: dict[tuple[str, ...], Any] = {}
    for cell in cells:
        if cell.overrides in configs:
            continue
        try:
            configs[cell.overrides] = compose_settings([*cell.overrides, *_ALWAYS])
            validate(configs[cell.overrides])
        except USER_ERRORS as error:
            raise ValueError(f"cell {cell.name} cannot be run: {error}") from error
    return [Task(cell, run_dir, configs[cell.overrides]) for cell in cells]


def run_task(task: Task) -> str | None:
    """Run a cell in whatever process this is; what it prints goes to a file in ``logs``.

    Returns:
        What went wrong, or None.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    log = task.run_dir / "logs" / f"{task.cell.name}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    problem = None
    # Killed processes hold no lock, even on another machine.
    with locked(log):
        with (
            log.open("w", encoding="utf-8") as file,
            contextlib.redirect_stdout(file),
            contextlib.redirect_stderr(file),
            without_lines(),
        ):
            try:
                # Another machine may have run it while this one waited.
                if not is_finished(task.cell, task.run_dir):
                    _train(task)
            except Exception as error:
                traceback.print_exc()
                kind = "" if isinstance(error, USER_ERRORS) else f"{type(error).__name__}: "
                problem = f"{kind}{error} (see {log})"
        if log.stat().st_size == 0:
            log.unlink()
    return problem


def _train(task: Task) -> None:
    cell, folder = task.cell, task.cell.folder(task.run_dir)
    config = copy.deepcopy(task.config)
    config.seed, config.run_dir = cell.seed, str(folder)
    if cell.source is not None:
        source = cell.source.folder(task.run_dir)
        config.data.load, config.data.save = str(source / "data"), False
        if (source / "baselines").is_dir():
            config.evaluation.baselines_from = str(source / "baselines")
    if not cell.reward_baselines:
        config.evaluation.reward_baselines = False
    seconds = None
    if not _resume(config, folder):
        shutil.rmtree(folder, ignore_errors=True)
        started = time.perf_counter()
        train_popl.run(config)
        seconds = round(time.perf_counter() - started, 2)
    # Last, as a sign that the cell is finished.
    record = {
        **cell.record(),
        "seconds": seconds,
        "disk": size_of(folder),
        "memory": peak_memory(),
        "results": results_digest(folder),
    }
    write_json(folder / "cell.json", sealed(record))


def _resume(config: Any, folder: Path) -> bool:
    """Finish what a killed process has left, if that is the same run; whether it worked."""
    stored = folder / "config.yaml"
    if not stored.is_file() or stored.read_text("utf-8") != config_text(plain(config)):
        return False
    again = copy.deepcopy(config)
    again.resume = str(folder)
    try:
        train_popl.run(again)
    except HeldError:
        raise  # another process is at it, and what it has done is not to be removed
    except Exception:
        traceback.print_exc()
        return False
    return True
