"""Faults by the hundred: what people type, what plug-ins do, what happens to files.

Everything is drawn from a seed and bounded by time. ``POPL_CAMPAIGN`` is the share of the cases
that is run, 1 if it is not set. A case passes if it is refused with a reason, or does what it
should.
"""

import os
import random
import signal
import sys
import time
import traceback
import warnings
from dataclasses import dataclass

import pytest

from popl_rl.trainers import train_popl

#: A run to its report in a few seconds.
TINY = [
    "env.options.size=7",
    "env.max_steps=20",
    "method.generations=2",
    "method.members=3",
    "method.training.steps=8",
    "method.training.batch_size=16",
    "method.refinement.steps=4",
    "method.popl.specialist_steps=2",
    "method.popl.pooled_steps=2",
    "method.hidden=[4]",
    "data.segments=60",
    "data.length=5",
    "raters.count=6",
    "raters.answers=6",
    "evaluation.episodes=4",
    "evaluation.new_raters=2",
    "evaluation.answers=3",
    "evaluation.curve=[2]",
    "evaluation.curve_members=2",
    "evaluation.pairs=40",
    "evaluation.history=0",
    "evaluation.learning_curve=0",
    "logger=csv",
]


@dataclass(frozen=True)
class Outcome:
    """How a command ended: exit code, what was printed, seconds."""

    code: int
    text: str
    seconds: float


@pytest.fixture(scope="session")
def tiny_settings():
    """``TINY``; the first is for two doors alone."""
    return list(TINY)


@pytest.fixture(scope="session")
def part():
    """Takes from a list of cases the share that is to be run, in an order drawn from a seed."""

    def take(cases, seed=0):
        share = float(os.environ.get("POPL_CAMPAIGN", "1"))
        count = max(1, round(share * len(cases)))
        return random.Random(seed).sample(cases, count)

    return take


@pytest.fixture
def train(monkeypatch, tmp_path, capsys):
    """Runs ``popl-train`` in an empty folder, in this process; what it raises is a failure."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def run(*overrides, tiny=tuple(TINY)):
        monkeypatch.setattr(sys, "argv", ["popl-train", *tiny, *overrides])
        started, code = time.monotonic(), 0
        capsys.readouterr()
        try:
            train_popl.cli()
        except SystemExit as leave:
            code = leave.code
        return Outcome(code, "".join(capsys.readouterr()), time.monotonic() - started)

    return run


@pytest.fixture
def child(tmp_path):
    """Runs ``popl-train`` in a fork of this process: exit code (negative: a signal), and its text.

    ``before`` is called in the child; ``after`` are seconds until it is killed.
    """

    def start(*overrides, before=lambda: None):
        told = tmp_path / f"told-{time.monotonic_ns()}.txt"
        sys.stdout.flush()
        sys.stderr.flush()
        process = os.fork()
        if process == 0:
            _train_and_leave(told, overrides, before)
        return process, told

    def wait(process, told):
        status = os.waitpid(process, 0)[1]
        return os.waitstatus_to_exitcode(status), told.read_text() if told.exists() else ""

    def run(*overrides, before=lambda: None, after=None):
        process, told = start(*overrides, before=before)
        if after is not None:
            time.sleep(after)
            os.kill(process, signal.SIGKILL)
        return wait(process, told)

    run.start, run.wait = start, wait
    return run


def _train_and_leave(told, overrides, before):
    code = 1
    try:
        file = os.open(told, os.O_CREAT | os.O_WRONLY)
        for number in (1, 2):
            os.dup2(file, number)
        sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
        warnings.resetwarnings()
        sys.argv = ["popl-train", *overrides]
        before()
        train_popl.cli()
        code = 0
    except SystemExit as leave:
        code = leave.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)
