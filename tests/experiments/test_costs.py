import json

import pytest

from popl_rl.config import (
    Config,
    EvaluationConfig,
    MethodConfig,
    POPLSettings,
    RatersConfig,
    RefinementSettings,
    Training,
)
from popl_rl.config.data import DataConfig
from popl_rl.experiments.cells import Cell
from popl_rl.experiments.costs import Cost, calibrate, kinds_of_cells, size_of

OLD, NEW = ("method=old",), ("method=new",)


def cells():
    return [Cell("plain", "old", seed, OLD) for seed in (0, 1, 2)] + [Cell("plain", "new", 0, NEW)]


def record(folder, *, seconds, overrides, **more):
    folder.mkdir(parents=True)
    (folder / "results.csv").write_text("method,choice,group,measure,value\n")
    (folder / "data.bin").write_bytes(bytes(1000))
    about = {"seconds": seconds, "overrides": list(overrides), **more}
    (folder / "cell.json").write_text(json.dumps(about))


def test_cells_of_the_same_settings_tell_what_others_will_cost(tmp_path):
    """Two runs of another benchmark took 30 and 50 s; nobody has run the other method."""
    for seed, seconds in enumerate([30, 50, None]):
        folder = tmp_path / "earlier/cells/plain/old" / f"seed{seed}"
        record(folder, seconds=seconds, overrides=OLD, memory=7, disk=2000 + seed)
    asked = []

    def calibrated(cell):
        asked.append(cell)
        return Cost((1.0, 2.0), 3.0, 4.0)

    old, new = kinds_of_cells(cells(), tmp_path / "mine", calibrated)
    assert (old.scenario, old.method, old.cells, old.unfinished) == ("plain", "old", 3, 3)
    assert old.cost == Cost((30, 50), 2001, 7)
    assert old.source == "2 runs"
    assert [cell.overrides for cell in asked] == [NEW]
    assert new.cost.seconds == (1.0, 2.0)


def test_one_run_says_less_than_two(tmp_path):
    record(tmp_path / "earlier/cells/plain/old/seed0", seconds=100, overrides=OLD)
    (old, _) = kinds_of_cells(cells(), tmp_path / "mine", lambda _: Cost((1, 1), 1, 1))
    low, high = old.cost.seconds
    assert low < 100 < high
    files = tmp_path / "earlier/cells/plain/old/seed0"
    assert old.cost.disk == size_of(files) > 1000, "records of earlier versions do not say"


def test_a_calibration_looks_at_the_cell_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def config(steps):
        return Config(
            raters=RatersConfig(groups=["upper", "lower"], count=8, answers=6),
            data=DataConfig(segments=40),
            method=MethodConfig(
                members=4,
                generations=steps,
                training=Training(steps=steps, batch_size=4),
                popl=POPLSettings(pooled_steps=1, specialist_steps=1),
                refinement=RefinementSettings(steps=0),
            ),
            evaluation=EvaluationConfig(baselines=False, pairs=100),
        )

    short, long = calibrate(config(3)), calibrate(config(100_000))
    assert not list(tmp_path.iterdir())
    assert 0 < short.seconds[0] < short.seconds[1]
    assert long.seconds[0] > 3 * short.seconds[0]
    assert short.disk > 40 * 12
    assert short.memory > 2**20


@pytest.mark.parametrize("missing", ["seconds", "overrides"])
def test_damaged_records_tell_nothing(tmp_path, missing):
    folder = tmp_path / "earlier/cells/plain/old/seed0"
    record(folder, seconds=100, overrides=OLD)
    about = json.loads((folder / "cell.json").read_text())
    del about[missing]
    (folder / "cell.json").write_text(json.dumps(about))
    told = kinds_of_cells(cells(), tmp_path / "mine", lambda _: Cost((1, 1), 1, 1))
    assert [kind.source for kind in told] == ["3 generations"] * 2
