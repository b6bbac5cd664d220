"""What a run can do without spoils no run: logger, pictures, animations, terminal."""

import io
import os
import subprocess
import sys
import warnings

import pytest
from matplotlib.figure import Figure

from popl_rl.accessories import accessory
from popl_rl.experiments import loggers
from popl_rl.experiments.loggers import RunLogger, make_logger
from popl_rl.plotting import run_figures
from popl_rl.trainers import train_popl
from popl_rl.trainers.terminal import steady_terminal

BARE = """
import gymnasium
import numpy as np


class Bare(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 2
        return self.seen(), {"state": 2, "next_state": 2}

    def step(self, action):
        before, self.cell = self.cell, min(max(self.cell + 2 * int(action) - 1, 0), 4)
        return self.seen(), 0.0, False, False, {"state": before, "next_state": self.cell}

    def seen(self):
        return np.array([self.cell / 4], np.float32)

    def render(self):
        FAULT


def left(segments):
    return -segments["info", "next_state"].float()


def right(segments):
    return segments["info", "next_state"].float()
"""
OWN = [
    "env=custom",
    "env.factory=bare.py:Bare",
    "raters.groups=[bare.py:left,bare.py:right]",
    "raters.label=return",
    "evaluation.figures=true",
    "evaluation.animate=true",
]


def test_an_accessory_that_fails_is_a_warning_that_says_what_is_missing():
    message = r"no picture \(AttributeError: egl\); install a renderer"
    picture = accessory("there is no picture", "install a renderer")
    with pytest.warns(UserWarning, match=message), picture:
        raise AttributeError("egl")
    with pytest.raises(KeyboardInterrupt), accessory("", ""):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    "fault",
    [
        "raise AttributeError(\"'NoneType' object has no attribute 'eglQueryString'\")",
        "return None",
    ],
)
def test_rendering_that_fails_spoils_no_run(fault, tmp_path, monkeypatch, tiny, config_of):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare.py").write_text(BARE.replace("FAULT", fault))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        train_popl.run(config_of(*tiny[1:], *OWN, "run_dir=run"))
    assert {"there is no animation for left", "there is no animation for right"} <= {
        str(one.message).partition(" (")[0] for one in told
    }
    assert "learning.png" in (tmp_path / "run" / "report.md").read_text()
    assert (tmp_path / "run" / "results.csv").is_file()
    assert not list((tmp_path / "run").rglob("*.gif"))


def test_pictures_that_fail_leave_the_others_and_a_report(tmp_path, tiny, config_of, monkeypatch):
    def broken(*_arguments, **_options):
        assert (tmp_path / "run" / "report.md").is_file()  # written first
        raise ImportError("no fonts")

    monkeypatch.setattr(run_figures, "recovery_bars", broken)
    with pytest.warns(UserWarning, match=r"no picture of recovery \(ImportError: no fonts\)"):
        train_popl.run(config_of(*tiny, "evaluation.figures=true", f"run_dir={tmp_path / 'run'}"))
    report = (tmp_path / "run" / "report.md").read_text()
    assert "occupancy.png" in report
    assert "recovery.png" not in report


class Lost(RunLogger):
    """A logger whose helper process is gone."""

    abandoned = 0

    def __init__(self, *_arguments, **_options):
        pass

    def log(self, *_arguments):
        raise ConnectionResetError("Connection lost")

    def abandon(self):
        Lost.abandoned += 1
        raise ConnectionResetError("Connection lost")


def test_a_logger_that_is_lost_is_told_once(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers, "_WandbRunLogger", Lost)
    logger = make_logger("wandb", tmp_path, project="x", config={})
    with pytest.warns(UserWarning, match=r"lacks what comes from here on \(ConnectionReset"):
        logger.log({"a": 1.0}, 1)
    logger.log({"a": 1.0}, 2)  # warnings are errors: it is told once
    logger.log_figures({"a": Figure()}, 2)
    logger.close()
    assert Lost.abandoned == 1


def test_a_resumed_run_goes_on_in_its_wandb_run(tmp_path):
    pytest.importorskip("wandb")
    for step in (1, 2):
        with make_logger("wandb", tmp_path, project="x", config={}) as logger:
            logger.log({"a": 1.0}, step)
    parts = sorted((tmp_path / "wandb").glob("offline-run-*"))
    # offline-run-<time>-<id>, and a number where two began in the same second.
    assert len({part.name.split("-")[3] for part in parts}) == 1
    assert len(list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))) >= 1


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [("utf-8", "−1 ± 0.5 ≤ λ"), ("latin-1", "-1 ± 0.5 ? ?"), ("cp1252", "-1 ± 0.5 ? ?"),
     ("ascii", "-1 +- 0.5 ? ?")],
)  # fmt: skip
def test_a_terminal_of_few_characters_shows_what_it_can(monkeypatch, encoding, shown):
    kept = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(kept, encoding=encoding))
    with steady_terminal():
        sys.stdout.write("−1 ± 0.5 ≤ λ\n")
    assert kept.getvalue().decode(encoding) == f"{shown}\n"


@pytest.mark.parametrize("target", ["closed pipe", "/dev/full"])
def test_a_terminal_that_is_gone_ends_nothing(target):
    script = (
        "import sys\nfrom popl_rl.trainers.terminal import steady_terminal\n"
        "with steady_terminal():\n"
        "    for _ in range(9):\n        print('line', flush=True)\n"
        "        print('line', file=sys.stderr, flush=True)\n"
        "    sys.exit(7)\n"
    )
    if target == "closed pipe":
        reading, writing = os.pipe()
        os.close(reading)
    else:
        writing = os.open(target, os.O_WRONLY)
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, stdout=writing, stderr=writing, timeout=60, check=False)
    os.close(writing)
    assert done.returncode == 7
