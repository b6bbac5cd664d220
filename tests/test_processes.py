"""Worker processes keep what they are given, tell what fails, and leave."""

import multiprocessing
import os
import time
from concurrent.futures.process import BrokenProcessPool

import pytest

from popl_rl.processes import Workers, count_workers, workers_for
from popl_rl.trainers.command import run_command


def test_each_worker_is_one_process_that_works_in_turn():
    others = set(multiprocessing.active_children())
    with Workers(2, threads=None) as workers:
        assert len(workers) == 2
        first = [workers.submit(0, os.getpid) for _ in range(3)]
        other = workers.submit(1, os.getpid)
        assert len({reply.result() for reply in first}) == 1
        assert other.result() != first[0].result()
        assert os.getpid() not in (first[0].result(), other.result())
        assert workers.submit(0, os.getpid).result() == first[0].result()
        with pytest.raises(ValueError, match="non-negative"):
            workers.submit(1, time.sleep, -1).result()
    assert set(multiprocessing.active_children()) <= others


def test_what_has_not_begun_is_not_done_at_the_end(tmp_path):
    with Workers(1, threads=None) as workers:
        workers.submit(0, os.getpid).result()
        for _ in range(9):  # a few of which are on their way, and are done
            workers.submit(0, time.sleep, 0.05)
        last = workers.submit(0, (tmp_path / "done").touch)
    assert last.cancelled()
    assert not (tmp_path / "done").exists()


def test_a_killed_worker_is_told():
    with Workers(1, threads=None) as workers:
        with pytest.raises(BrokenProcessPool):
            workers.submit(0, os._exit, 1).result()
        with pytest.raises(BrokenProcessPool, match=r"worker process 0 was killed.*fewer workers"):
            workers.submit(0, os.getpid)


def test_a_killed_worker_is_told_with_a_cure(monkeypatch, capsys):
    """Whoever waits for a result, a command ends with one line and no traceback."""

    def main():
        with workers_for(2, threads=1) as workers:
            workers.submit(1, os._exit, 1).result()

    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr("sys.argv", ["popl-train"])
    with pytest.raises(SystemExit) as stop:
        run_command(main)
    assert stop.value.code == 2
    said = "error: a worker process was killed; if memory ran out, set fewer workers"
    assert capsys.readouterr().err.strip() == said


def test_one_worker_is_this_process():
    with workers_for("1", threads=1) as workers:
        assert workers is None
    assert count_workers("3") == 3
    assert count_workers("auto") == len(os.sched_getaffinity(0))
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        Workers(0)
