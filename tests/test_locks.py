"""One process at a time, and everybody else is told who it is."""

import multiprocessing
import os
import signal
import socket
import time

import pytest

from popl_rl.locks import HeldError, held, locked

FORK = multiprocessing.get_context("fork")


def _hold(file, holding):
    with held(file, what="the run"):
        holding.set()
        time.sleep(60)


@pytest.fixture
def holder(tmp_path):
    holding = FORK.Event()
    process = FORK.Process(target=_hold, args=(tmp_path / ".lock", holding))
    process.start()
    assert holding.wait(30)
    yield process
    process.kill()
    process.join(30)


def test_who_holds_a_lock_is_named(tmp_path, holder):
    message = f"the run is in use by process {holder.pid} on {socket.gethostname()}, for 0 minutes"
    with pytest.raises(HeldError, match=message), held(tmp_path / ".lock", what="the run"):
        pass


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"process": 3}'])
def test_a_lock_holds_whatever_its_file_says(tmp_path, holder, text):
    (tmp_path / ".lock").write_text(text)
    with pytest.raises(HeldError, match="another process"), held(tmp_path / ".lock", what="it"):
        pass


def test_the_lock_of_a_killed_process_is_free(tmp_path, holder):
    os.kill(holder.pid, signal.SIGKILL)
    holder.join(30)
    with held(tmp_path / ".lock", what="the run"):
        assert str(os.getpid()) in (tmp_path / ".lock").read_text()


def _wait(path, entered):
    with locked(path):
        entered.set()


def test_waiting_says_for_whom(tmp_path, capfd):
    entered = FORK.Event()
    with locked(tmp_path / "store"):
        process = FORK.Process(target=_wait, args=(tmp_path / "store", entered))
        process.start()
        assert not entered.wait(0.5)
    assert entered.wait(30)
    process.join(30)
    told = f"waiting for {tmp_path / 'store'}, which is being made by process {os.getpid()}"
    assert told in capfd.readouterr().err
