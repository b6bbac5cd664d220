"""popl-benchmark as it is: its own suites, worker processes and launchers."""

import sys
from importlib.resources import files
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf

from popl_rl.evaluation.statistics import RESULT_COLUMNS, read_results
from popl_rl.experiments.cells import plan
from popl_rl.experiments.suites import load_suite
from popl_rl.trainers import benchmark_cells, run_benchmark
from popl_rl.trainers.run_benchmark import BenchmarkConfig, run


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)


def config(**changes):
    options = {"suite": "mine.yaml", "seeds": 1, "workers": 0, "run_dir": "out", **changes}
    return BenchmarkConfig(**options)


def cell_folder(name):
    return Path("out/cells") / name


@pytest.fixture
def call(monkeypatch, capsys):
    def call(*overrides):
        monkeypatch.setattr(sys, "argv", ["popl-benchmark", *overrides])
        code = 0
        try:
            run_benchmark.cli()
        except SystemExit as leave:
            code = leave.code
        out, err = capsys.readouterr()
        return code, out + err

    return call


@pytest.mark.parametrize("name", ["smoke", "stateless", "sweeps", "two_doors"])
def test_scenarios_and_methods_of_our_suites_are_configurations(name):
    suite = load_suite(name, folder=files("popl_rl.configs.suites"))
    cells = plan(suite, seeds=1)
    # Every scenario and every method, but not every pair: it takes long.
    chosen = [cell for cell in cells if cell.leads or cell.scenario == cells[0].scenario]
    assert len(benchmark_cells.make_tasks(chosen, Path())) == len(chosen)


def test_a_real_benchmark_in_a_worker_process(tiny, capfd):
    """What methods are compared with is the same for all of them."""
    overrides = OmegaConf.to_yaml({"overrides": [one for one in tiny if one != "logger=csv"]})
    scenarios = "methods: {popl: [], other: ['method.hidden=[6]']}\nscenarios: {plain: []}\n"
    Path("mine.yaml").write_text(overrides + scenarios)
    result = run(config(workers=1))
    assert result.failures == {}
    results = pd.read_csv("out/results.csv")
    assert set(results.method) == {
        "popl",
        "other",
        "pooled_cpl",
        "oracle",
        "random",
        "optimum",
        "behaviour",
        "best_behaviour",
        "data",
    }
    first, other = (cell_folder(f"plain/{name}/seed0") for name in ("popl", "other"))
    assert (first / "data").is_dir()
    assert not (other / "data").exists()
    own, shared = (
        read_results(folder / "results.csv").set_index(RESULT_COLUMNS[:-1]).value
        for folder in (other, first)
    )
    for baseline in ("pooled_cpl", "oracle", "random"):
        pd.testing.assert_series_equal(own[baseline], shared[baseline])
    assert not own["popl"].equals(shared["popl"])
    assert not list(Path("out/logs").rglob("*.txt")), "no warnings"
    assert Path("out/figures/recovery.png").stat().st_size > 1000
    output = capfd.readouterr()
    assert output.out == ""
    # On a slow machine there are lines of progress.
    assert all(line.startswith("cells: ") for line in output.err.splitlines())


@pytest.mark.slow
def test_a_launcher_takes_cells_to_other_processes(call, tiny):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    overrides = OmegaConf.to_yaml({"overrides": [one for one in tiny if one != "logger=csv"]})
    methods = "methods: {popl: [], other: [method.training.steps=3]}\nscenarios: {plain: []}\n"
    Path("mine.yaml").write_text(overrides + methods)
    launcher = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    code, text = call("-m", "suite=mine.yaml", "seeds=1", "run_dir=out", "cell=0,1", *launcher)
    assert code == 0, text
    folders = [cell_folder(f"plain/{method}/seed0") for method in ("popl", "other")]
    written = [(folder / "cell.json").read_bytes() for folder in folders]
    result = run(config())
    assert result.failures == {}
    assert [(folder / "cell.json").read_bytes() for folder in folders] == written
    assert set(result.results.method) >= {"popl", "other", "oracle"}
