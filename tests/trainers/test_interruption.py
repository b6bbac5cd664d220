"""SIGTERM and Ctrl-C end a command in order, and a killed sweep can be run again."""

import gc
import os
import signal
import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path

import pytest

from popl_rl.interruption import Terminated, importing, is_asked_to_end, listening, putting_off
from popl_rl.trainers import train_popl


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def test_sigterm_raises_where_a_command_listens():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Terminated), listening():
        terminate()
    assert signal.getsignal(signal.SIGTERM) is before


def test_sigterm_is_put_off_once():
    with listening():
        with putting_off():
            terminate()
            assert is_asked_to_end()
            with pytest.raises(Terminated):
                terminate()
        assert is_asked_to_end()
    with listening():
        assert not is_asked_to_end()


def test_threads_leave_signals_alone():
    def listen():
        with listening(), importing(always=True):
            pass

    thread = threading.Thread(target=listen)
    thread.start()
    thread.join()


@pytest.fixture
def train(monkeypatch, tmp_path, capfd):
    """Run popl-train as from the shell, in an empty folder: exit code and what was printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def call(*overrides):
        monkeypatch.setattr(sys, "argv", ["popl-train", *overrides])
        code = 0
        try:
            train_popl.cli()
        except SystemExit as leave:
            code = leave.code
        out, err = capfd.readouterr()
        return code, out + err

    return call


def stopping_at(monkeypatch, generation):
    """SIGTERM within a generation of whatever is trained."""
    from popl_rl.algorithms.popl import POPL

    step = POPL.step

    def stop(method):
        metrics = step(method)
        if method.generation == generation:
            terminate()
        return metrics

    monkeypatch.setattr(POPL, "step", stop)


def test_sigterm_writes_a_checkpoint_and_says_how_to_go_on(train, tiny, monkeypatch):
    whole, _ = train(*tiny, "run_dir=whole")
    assert whole == 0
    with monkeypatch.context() as patch:
        stopping_at(patch, 2)
        code, text = train(*tiny, "run_dir=stopped")
    assert code == 143, text
    assert "terminated; continue with: popl-train resume=stopped" in text
    assert "Traceback" not in text
    assert [path.name for path in Path("stopped/checkpoint").iterdir()] == [
        "checkpoint-000000000002.torchrl"
    ]
    code, text = train("resume=stopped")
    assert code == 0, text
    for name in ("metrics.csv", "results.csv"):
        assert Path("stopped", name).read_bytes() == Path("whole", name).read_bytes()


def test_a_killed_sweep_is_run_again(train, tiny, monkeypatch):
    sweep = ["-m", *tiny, "seed=0,1", "run_dir=sweep/${seed}"]
    with monkeypatch.context() as patch:
        stopping_at(patch, 2)
        code, text = train(*sweep)
    assert code == 143, text
    assert not Path("sweep/0/report.md").exists()
    code, text = train(*sweep)
    assert code == 0, text
    before = Path("sweep/0/results.csv").stat().st_mtime_ns
    assert Path("sweep/1/report.md").is_file()
    code, text = train(*sweep)
    assert code == 0, text
    assert "sweep/0 is finished, and left as it is" in text
    assert Path("sweep/0/results.csv").stat().st_mtime_ns == before
    assert [path.name for path in Path().iterdir()] == ["sweep"], "nothing of Hydra's is left"
    code, text = train(*sweep, "method.generations=4")
    assert code == 2
    assert "exists and is not empty" in text


def test_two_processes_do_not_work_on_one_run(train, tiny):
    assert train(*tiny, "run_dir=run", "evaluation.baselines=false")[0] == 0
    script = (
        "import sys, time; from pathlib import Path; from popl_rl.locks import held\n"
        "with held(Path('run/.lock'), what='it'):\n  print('held', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline()
        code, text = train("resume=run")
    finally:
        holder.kill()
        holder.communicate()
    assert code == 2
    assert f"run, the folder of a run, is in use by process {holder.pid} on" in text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_while_libraries_are_imported_is_no_traceback(number):
    script = (
        "import os, signal; from popl_rl.interruption import importing\n"
        # Whoever runs tests in the background has told them to ignore it.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with importing(always=True):\n"
        f"  os.kill(os.getpid(), {int(number)}); import unittest"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True
    )
    assert done.returncode == 128 + number
    assert done.stderr == "\ninterrupted before anything was begun\n"


def test_what_is_imported_is_left_out_of_garbage_collections(tmp_path, monkeypatch):
    (tmp_path / "never_seen_before.py").write_text("kept = [[] for _ in range(1000)]\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = gc.get_freeze_count()
    with importing():
        pass
    assert gc.get_freeze_count() == before, "nothing is new, and there may be garbage"
    with importing():
        import_module("never_seen_before")
    assert gc.get_freeze_count() >= before + 1000
    assert gc.isenabled()
