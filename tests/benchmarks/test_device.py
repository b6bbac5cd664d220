"""The script of a person with a GPU runs on a processor too, at a tiny size."""

import runpy
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch

SCRIPT = Path(__file__).parent / "device.py"


@pytest.fixture
def start(monkeypatch):
    """Runs the script in this process, which has loaded what it needs."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["device.py", *arguments])
        runpy.run_path(str(SCRIPT), run_name="__main__")

    return run


def test_every_work_is_timed_on_a_processor(start, tmp_path):
    start("--device", "cpu", "--share", "0.0002", "--out", str(tmp_path / "device.csv"))
    table = pd.read_csv(tmp_path / "device.csv")
    assert len(table) == 3
    assert table["seconds"].gt(0).all()
    assert set(table["device"]) == {"processor"}
    assert table["gib"].isna().all()


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_a_missing_gpu_is_told_of(start, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        start("--device", "cuda", "--out", str(tmp_path / "device.csv"))
    assert ended.value.code == 2
    assert "needs a GPU that torch sees" in capsys.readouterr().err
    assert not (tmp_path / "device.csv").exists()
