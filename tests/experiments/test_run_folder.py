import errno
import io
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from rich.console import Console

from popl_rl.config import load_config
from popl_rl.experiments.loggers import make_logger
from popl_rl.experiments.metrics import MetricsWriter
from popl_rl.experiments.progress import Progress, in_words
from popl_rl.experiments.run_folder import (
    create_run_dir,
    git_state,
    save_config,
    write_metadata,
)
from popl_rl.storage import write_atomic, write_json


def test_a_run_folder_is_made_where_it_was_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "new" / "run"
    assert create_run_dir(path, name="popl") == path
    assert path.is_dir()
    assert create_run_dir(path, name="popl") == path, "an empty folder will do"


def test_a_run_folder_gets_a_name_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = {create_run_dir(None, name="my/popl 1") for _ in range(5)}
    assert len(folders) == 5
    for folder in folders:
        assert folder.is_dir()
        assert folder.parent == Path("runs")
        assert "-my-popl-1" in folder.name


def test_a_run_folder_with_something_in_it_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("a: 1\n")
    with pytest.raises(FileExistsError, match=r"is not empty; choose another run_dir.*resume="):
        create_run_dir(tmp_path, name="popl")
    assert create_run_dir(tmp_path, name="popl", resume=True) == tmp_path


def test_resuming_needs_a_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no run to resume in .* no config\.yaml"):
        create_run_dir(tmp_path, name="popl", resume=True)
    with pytest.raises(ValueError, match=r"path must name the run to resume, got None"):
        create_run_dir(None, name="popl", resume=True)


def test_writing_replaces_a_file_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomic(path, "Ünicode\n")
    assert path.read_bytes() == "Ünicode\n".encode()
    write_atomic(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "metadata.json"
    path.write_text("old")

    def fail(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*{"fsync": (os, "fsync"), "replace": (Path, "replace")}[failing], fail)
    message = r"could not write metadata\.json, the disk is full.*earlier are intact"
    with pytest.raises(OSError, match=message) as caught:
        write_atomic(path, "new")
    assert caught.value.errno == errno.ENOSPC
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
def test_a_full_disk_is_named_when_a_row_is_added(tmp_path: Path) -> None:
    writer = MetricsWriter(tmp_path / "metrics.csv")
    writer.write(1, {"a": 1.0})
    writer.path = Path("/dev/full")
    with pytest.raises(OSError, match="could not write full, the disk is full"):
        writer.write(2, {"a": 1.0})


def test_other_errors_of_the_disk_are_passed_on(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_atomic(tmp_path / "missing" / "file", "")


def test_json_is_readable(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [1, None]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [1, None]}
    assert (tmp_path / "a.json").read_text().endswith("\n")


@dataclass
class Config:
    seed: int = 3
    name: str = "run-${seed}"


@pytest.mark.parametrize("cfg", [Config(), {"seed": 3, "name": "run-${seed}"}])
def test_the_config_is_written_resolved(tmp_path: Path, cfg: Any) -> None:
    for given_as in (cfg, OmegaConf.create(cfg)):
        save_config(tmp_path, given_as)
        assert "${" not in (tmp_path / "config.yaml").read_text()
        assert load_config(tmp_path) == {"seed": 3, "name": "run-3"}


def test_a_missing_or_broken_config_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="give the folder of a run"):
        load_config(tmp_path)
    (tmp_path / "config.yaml").write_text("a: [1,")
    with pytest.raises(ValueError, match="not valid YAML"):
        load_config(tmp_path)
    (tmp_path / "config.yaml").write_text("[1, 2]")
    with pytest.raises(ValueError, match="must be a mapping"):
        load_config(tmp_path)


def test_metadata_say_what_was_run_with_what(tmp_path: Path) -> None:
    write_metadata(tmp_path, command=["popl-train", "env=two doors"])
    data = json.loads((tmp_path / "metadata.json").read_text())
    assert data["command"] == "popl-train 'env=two doors'"
    assert data["versions"]["numpy"] == np.__version__
    assert data["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert {"popl_rl", "torch", "torchrl", "tensordict", "wandb"} < data["versions"].keys()
    assert {"started", "git", "platform", "device"} < data.keys()
    assert "resumed" not in data


def test_metadata_of_a_resumed_run_are_added(tmp_path: Path) -> None:
    for command in ("first", "second", "third"):
        write_metadata(tmp_path, command=[command])
    data = json.loads((tmp_path / "metadata.json").read_text())
    assert data["command"] == "first"
    assert [entry["command"] for entry in data["resumed"]] == ["second", "third"]


def test_the_commit_is_none_outside_of_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert git_state(tmp_path) is None
    assert git_state(Path(__file__).parent) is None, "not the top of its checkout"
    monkeypatch.setenv("PATH", "")
    assert git_state(Path(__file__).parents[1]) is None, "no git"


def test_the_commit_and_changes_of_a_checkout_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("GIT_AUTHOR_NAME", "GIT_COMMITTER_NAME"):
        monkeypatch.setenv(variable, "n")
    for variable in ("GIT_AUTHOR_EMAIL", "GIT_COMMITTER_EMAIL"):
        monkeypatch.setenv(variable, "n@example.org")
    try:
        subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    except FileNotFoundError:
        pytest.skip("needs git")
    assert git_state(tmp_path) is None, "no commit yet"
    commit = ["commit", "-q", "--allow-empty", "-m", "m"]
    subprocess.run(["git", "-C", str(tmp_path), *commit], check=True)
    clean = git_state(tmp_path)
    assert clean is not None
    assert len(clean["commit"]) == 40
    assert clean["dirty"] is False
    (tmp_path / "new").touch()
    assert git_state(tmp_path) == {**clean, "dirty": True}


def test_metrics_have_a_row_per_generation_and_fixed_columns(tmp_path: Path) -> None:
    writer = MetricsWriter(tmp_path / "metrics.csv")
    writer.write(1, {"b": 0.1, "a": float("nan")})
    writer.write(2, {"a": 1 / 3})
    assert (tmp_path / "metrics.csv").read_text() == (
        "generation,b,a\n1,0.1,nan\n2,,0.3333333333333333\n"
    )
    with pytest.raises(ValueError, match=r"\['generation', 'b', 'a'\], got the new \['c'\]"):
        writer.write(3, {"c": 1.0})
    # Opened again, it still knows its columns.
    with pytest.raises(ValueError, match=r"got the new \['c'\]"):
        MetricsWriter(tmp_path / "metrics.csv").write(3, {"c": 1.0})


def test_metrics_can_be_cut_back(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    writer = MetricsWriter(path)
    writer.truncate_to(0)
    for generation in (1, 2, 10):
        writer.write(generation, {"a": 0.5})
    writer.truncate_to(2)
    assert path.read_text() == "generation,a\n1,0.5\n2,0.5\n"
    writer.truncate_to(0)
    assert not path.exists()
    writer.write(1, {"b": 0.5})
    assert path.read_text() == "generation,b\n1,0.5\n"


ROWS = [{"loss": 1 / (generation + 1), "depth": float(generation)} for generation in range(7)]


@settings(max_examples=40, deadline=None)
@given(cut=st.integers(0, 200), checkpoint=st.integers(0, 6))
def test_metrics_after_a_kill_end_as_if_there_had_been_none(
    tmp_path_factory: pytest.TempPathFactory, cut: int, checkpoint: int
) -> None:
    whole, killed = (tmp_path_factory.mktemp("run") / "metrics.csv" for _ in range(2))
    writer = MetricsWriter(whole)
    for generation, row in enumerate(ROWS, 1):
        writer.write(generation, row)
    text = whole.read_text()
    first_row = len("".join(text.splitlines(keepends=True)[:2]))
    kept = text[: max(cut, first_row)]  # the first row comes with the header, all at once
    killed.write_text(kept)
    resumed = MetricsWriter(killed)
    done = min(checkpoint, kept.count("\n") - 1)  # a checkpoint is never ahead of the rows
    resumed.truncate_to(done)
    for generation, row in enumerate(ROWS[done:], done + 1):
        resumed.write(generation, row)
    assert killed.read_text() == text


@pytest.mark.parametrize("text", ["", "hello", "a,b\n1,2\n", "generation,a\nx,2\n"])
def test_a_file_that_is_no_table_of_metrics_is_left_alone(tmp_path: Path, text: str) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"metrics\.csv must be a table whose first column"):
        MetricsWriter(path)
    assert path.read_text() == text


def test_wandb_runs_offline_quietly_and_leaves_the_process_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "shared")
    rows: list[dict[str, Any]] = []
    log = wandb.Run.log

    def spy(run: Any, row: dict[str, Any]) -> None:
        rows.append(row)
        log(run, row)

    monkeypatch.setattr(wandb.Run, "log", spy)
    figure = Figure()
    figure.subplots().plot([1, 2])
    figure.savefig(tmp_path / "b.png")
    with make_logger("wandb", tmp_path, project="test", config={"seed": {"a": 1}}) as logger:
        assert os.environ["WANDB_MODE"] == "shared"
        logger.log({"loss": 0.5, "accuracy": 0.75}, 1)
        logger.log({"loss": 0.25, "accuracy": 1.0}, 2)
        logger.log_figures({"a": figure, "b": tmp_path / "b.png"}, 2)
        logger.log_table("results", pd.DataFrame({"method": ["popl", "cpl"], "value": [1, np.nan]}))
    assert wandb.run is None
    assert wandb.setup().settings.mode != "dryrun", "other runs of this process may be online"
    assert rows[:2] == [
        {"loss": 0.5, "accuracy": 0.75, "step": 1},
        {"loss": 0.25, "accuracy": 1.0, "step": 2},
    ]
    assert rows[2]["figures/step"] == 2
    assert len(list(tmp_path.glob("wandb/offline-run-*/*.wandb"))) == 1
    assert len(list(tmp_path.glob("wandb/offline-run-*/files/media/images/figures/*.png"))) == 2
    assert len(list(tmp_path.glob("wandb/offline-run-*/files/media/table/tables/*.json"))) == 1
    output = capfd.readouterr()
    assert output.out == output.err == ""


def test_without_wandb_the_run_goes_on_with_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.warns(UserWarning, match=r"metrics\.csv only.*pip install wandb.*logger=csv") as w:
        logger = make_logger("wandb", tmp_path, project="test", config={})
    assert len(w) == 1
    logger.log({"loss": 1.0}, 1)
    logger.close()


def test_if_wandb_does_not_start_the_run_goes_on_with_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.delenv("WANDB_MODE", raising=False)

    def init(**_: Any) -> None:
        raise wandb.errors.CommError("no service")

    monkeypatch.setattr(wandb, "init", init)
    with pytest.warns(UserWarning, match=r"did not start \(no service\)"):
        make_logger("wandb", tmp_path, project="test", config={}).log({"loss": 1.0}, 1)
    assert "WANDB_MODE" not in os.environ


def test_the_csv_logger_writes_nothing(tmp_path: Path) -> None:
    with make_logger("csv", tmp_path, project="test", config={}) as logger:
        logger.log({"loss": 1.0}, 1)
        logger.log_figures({"a": Figure()}, 1)
        logger.log_table("results", pd.DataFrame({"a": [1]}))
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_logger_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="logger must be 'wandb' or 'csv', got 'tensorboard'"):
        make_logger("tensorboard", tmp_path, project="p", config={})  # type: ignore[arg-type]


def test_progress_shows_generations_and_metrics_in_a_terminal() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120)
    with Progress("training", total=5, completed=1, console=console) as progress:
        progress.update(3, worst_rater_accuracy=0.61234, loss=2.0)
    shown = screen.getvalue()
    assert "training" in shown
    assert "1/5" in shown
    assert "3/5" in shown
    assert "worst rater accuracy 0.612, loss 2" in shown


def test_progress_of_a_moment_is_silent_elsewhere(capfd: pytest.CaptureFixture[str]) -> None:
    with Progress("training", total=5) as progress:
        progress.update(5, loss=1.0)
    output = capfd.readouterr()
    assert output.out == output.err == ""


def test_progress_is_a_line_now_and_then_elsewhere(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five steps of four seconds: a line after 12 seconds, at 3 of 5, and one at the end."""
    clock = iter([0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 21.0])
    monkeypatch.setattr("popl_rl.experiments.progress.time.monotonic", lambda: next(clock))
    with Progress("training", total=5) as progress:
        for step in range(1, 6):
            progress.update(step, loss=1.0)
    lines = capfd.readouterr().err.splitlines()
    assert lines == [
        "training: 3 of 5 (60%), about 8 s left; loss 1",
        "training: done in about 21 s",
    ]


def test_times_are_told_as_people_say_them() -> None:
    assert [in_words(seconds) for seconds in (0.2, 61, 240, 7200)] == [
        "about 1 s",
        "about 61 s",
        "about 4 minutes",
        "about 2.0 hours",
    ]
