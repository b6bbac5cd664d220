"""What cells of a benchmark will cost, by those of their kind that were run, or calibrated."""

import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from popl_rl.config import Config
from popl_rl.experiments.cells import Cell, is_finished
from popl_rl.manifest import read_json

__all__ = ["Cost", "KindOfCell", "calibrate", "kinds_of_cells", "peak_memory", "size_of"]

_GENERATIONS = 3  # that a calibration runs
_REPORT = 2 << 20  # bytes of figures, policies and checkpoints, which it does not see
# Time of a cell against what is foreseen of it: by one cell alone; by a calibration, which sees
# neither the evaluation and figures nor members that join later.
_BY_ONE = (0.7, 1.5)
_CALIBRATED = (1.0, 3.0)


@dataclass(frozen=True)
class Cost:
    """What one cell costs.

    Attributes:
        seconds: Time from start to report on a core of its own, the least and the most.
        disk: Bytes of its folder.
        memory: Most bytes that its process holds.
    """

    seconds: tuple[float, float]
    disk: float
    memory: float


@dataclass(frozen=True)
class KindOfCell:
    """Cells that differ in their seeds alone.

    Attributes:
        scenario: Name of the scenario.
        method: Name of the method.
        cells: How many there are.
        unfinished: How many are still to be run.
        cost: Of each.
        source: Where that is known from.
    """

    scenario: str
    method: str
    cells: int
    unfinished: int
    cost: Cost
    source: str


def size_of(folder: Path) -> int:
    """Bytes of all files in a folder; what links lead to is not counted."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files)


def peak_memory() -> int:
    """Most bytes that this process has held so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def kinds_of_cells(
    cells: Sequence[Cell], run_dir: Path, calibrated: Callable[[Cell], Cost]
) -> list[KindOfCell]:
    """What cells of each kind cost.

    Finished cells with the same overrides tell, in this benchmark and in others beside it.

    Args:
        cells: All cells of the suite.
        run_dir: Folder of the benchmark, which need not exist.
        calibrated: Measures what a cell costs whose like nobody has run.
    """
    recorded = _recorded(run_dir)
    kinds: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        kinds.setdefault((cell.scenario, cell.method), []).append(cell)
    found = []
    for (scenario, method), alike in kinds.items():
        unfinished = [cell for cell in alike if not is_finished(cell, run_dir)]
        known = recorded.get(alike[0].overrides)
        if known:
            cost, source = _together(known), f"{len(known)} runs"
        else:
            cost, source = calibrated(alike[0]), f"{_GENERATIONS} generations"
        found.append(KindOfCell(scenario, method, len(alike), len(unfinished), cost, source))
    return found


def _recorded(run_dir: Path) -> dict[tuple[str, ...], list[Cost]]:
    """Costs of finished cells by their overrides; of records of earlier versions time alone."""
    found: dict[tuple[str, ...], list[Cost]] = {}
    for path in sorted(run_dir.parent.glob("*/cells/*/*/*/cell.json")):
        try:
            record = read_json(path, cure="")
            seconds, overrides = record["seconds"], tuple(record["overrides"])
        except (OSError, ValueError, KeyError, TypeError):
            continue  # a damaged record tells nothing
        if seconds is not None:
            disk = record.get("disk") or size_of(path.parent)
            cost = Cost((seconds, seconds), disk, record.get("memory", 0))
            found.setdefault(overrides, []).append(cost)
    return found


def _together(known: Sequence[Cost]) -> Cost:
    seconds = sorted(cost.seconds[0] for cost in known)
    low, high = seconds[0], seconds[-1]
    if len(known) == 1:
        low, high = low * _BY_ONE[0], high * _BY_ONE[1]
    return Cost((low, high), max(cost.disk for cost in known), max(cost.memory for cost in known))


def calibrate(config: Config) -> Cost:
    """Collect the data of a cell, run a few generations, and foresee the rest.

    Args:
        config: Settings of the cell, checked; nothing is left behind by it.
    """
    from popl_rl.experiments import steps
    from popl_rl.experiments.foresight import Foresight
    from popl_rl.experiments.preflight import survey

    # The processor's time, since others may keep it busy.
    began = time.process_time()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        place = survey(config)
        if place is None:
            raise ValueError("cells with raters=people cannot be planned, only run")
        setting = steps.gather(config, folder, place)
        method = steps.build(config, setting)
        foresight = Foresight(config, method, groups=len(setting.groups))
        ready = time.process_time()
        for _ in range(_GENERATIONS):
            method.step()
        each = (time.process_time() - ready) / _GENERATIONS
        ahead = foresight.ahead(0, each)[0]
        disk = size_of(folder) + _REPORT
    low, high = (factor * (ready - began + ahead) for factor in _CALIBRATED)
    return Cost((low, high), disk, peak_memory())
