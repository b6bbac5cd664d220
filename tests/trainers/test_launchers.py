"""Cells of a benchmark on Hydra's launchers for clusters, in processes of this machine."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from popl_rl.experiments.cells import plan
from popl_rl.experiments.suites import load_suite
from popl_rl.trainers.run_benchmark import BenchmarkConfig, run

MODULES = {"submitit_local": "hydra_submitit_launcher", "ray": "hydra_ray_launcher"}


@pytest.mark.cluster
@pytest.mark.timeout(900)
@pytest.mark.parametrize("launcher", MODULES)
def test_cells_run_by_a_launcher_are_collected(launcher, tiny, tmp_path, monkeypatch):
    module = f"hydra_plugins.{MODULES[launcher]}"
    if importlib.util.find_spec("hydra_plugins") is None or not importlib.util.find_spec(module):
        pytest.skip(f"needs pip install {MODULES[launcher].replace('_', '-')}")
    monkeypatch.chdir(tmp_path)
    overrides = [one for one in tiny if one != "logger=csv"]
    suite = {"overrides": overrides, "methods": {"popl": [], "cpl": ["method=cpl"]}}
    Path("mine.yaml").write_text(OmegaConf.to_yaml({**suite, "scenarios": {"plain": []}}))
    command = [sys.executable, "-m", "popl_rl.trainers.run_benchmark", "-m", "suite=mine.yaml"]
    command += ["run_dir=out", "seeds=1", "cell=0,1", f"hydra/launcher={launcher}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    cells = plan(load_suite("mine.yaml", folder=Path()), seeds=1)
    records = {cell.name: (cell.folder(Path("out")) / "cell.json") for cell in cells}
    before = {name: record.read_bytes() for name, record in records.items()}
    assert len(before) == 2
    result = run(BenchmarkConfig(suite="mine.yaml", seeds=1, run_dir="out", workers=0))
    assert result.failures == {}
    assert {name: record.read_bytes() for name, record in records.items()} == before
    assert {"popl", "cpl"} <= set(result.results["method"])
