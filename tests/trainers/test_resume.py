import os
import signal
import subprocess
import sys
import time

import pandas as pd
import pytest
import torch

from popl_rl.models.policy_set import PolicySet

# Three runs in processes of their own: half a minute on a quiet machine.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def start(folder, *overrides):
    command = [sys.executable, "-m", "popl_rl.trainers.train_popl", *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def rows_in(path):
    return path.read_text().count("\n") - 1 if path.exists() else 0


def finished(process):
    output, _ = process.communicate(timeout=200)
    assert process.returncode == 0, output.decode()


def test_a_killed_run_is_finished_as_if_it_had_never_stopped(tmp_path, tiny):
    settings = [*tiny, "checkpoint_interval=1", "method.generations=30", "evaluation.history=7"]
    whole = start(tmp_path, *settings, "run_dir=whole")
    killed = start(tmp_path, *settings, "run_dir=killed")
    metrics = tmp_path / "killed" / "metrics.csv"
    deadline = time.monotonic() + 120
    while rows_in(metrics) < 3:
        assert time.monotonic() < deadline, "no generation was finished"
        assert killed.poll() is None, killed.communicate()[0].decode()
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL
    assert 3 <= rows_in(metrics) < 30
    assert not (tmp_path / "killed" / "results.csv").exists()

    finished(start(tmp_path, "resume=killed"))
    finished(whole)
    for name in ("metrics.csv", "history.csv", "results.csv"):
        one, other = tmp_path / "whole" / name, tmp_path / "killed" / name
        assert one.read_bytes() == other.read_bytes(), name
    assert pd.read_csv(metrics).generation.tolist() == list(range(1, 31))
    for name in ("policies", "baselines"):
        one, other = (PolicySet.load(tmp_path / run / name) for run in ("whole", "killed"))
        assert one.origin == other.origin
        other_tensors = other.population.members.data
        for key, value in one.population.members.data.items(True, True):
            assert torch.equal(value, other_tensors[key]), (name, key)
