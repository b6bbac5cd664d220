"""The world that ``popl-new`` writes is complete: it passes checks, and one can train in it."""

import sys

import pandas as pd
import pytest

from popl_rl.testing import check_env, check_rater
from popl_rl.trainers import train_popl
from popl_rl.trainers.new_env import main


@pytest.fixture
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def test_what_is_written_passes_every_check_and_trains(here, monkeypatch, capsys, tiny):
    assert main(["my_world.py"]) == 0
    assert "popl-train --config-dir . env=my_world" in capsys.readouterr().out
    check_env("my_world.py:Exits")
    for group in ("up", "down"):
        check_rater(f"my_world.py:{group}", "my_world.py:Exits")
    quick = [one for one in tiny if not one.startswith(("env", "data.length", "method.training.b"))]
    given = ["--config-dir", ".", "env=my_world", *quick, "run_dir=run"]
    monkeypatch.setattr(sys, "argv", ["popl-train", *given])
    train_popl.cli()
    results = pd.read_csv("run/results.csv", dtype={"choice": "str"})
    assert set(results.group) == {"up", "down", "all"}
    assert {"wander", "go/up", "go/down"} <= set(results.choice)
    best = results[(results.method == "optimum") & (results.measure == "return")].value
    # From a start on the average some four steps away from one's own exit.
    assert best.between(0.5, 1.0).all()


def test_nothing_is_overwritten_and_names_must_do(here, capsys):
    (here / "env").mkdir()
    (here / "env" / "mine.yaml").touch()
    assert main(["mine.py"]) == 2
    assert "mine.yaml exists; choose another name" in capsys.readouterr().err
    assert not (here / "mine.py").exists()
    assert main(["my-env.py"]) == 2
    assert "must be a Python file such as my_env.py" in capsys.readouterr().err
