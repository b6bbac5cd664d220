import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from popl_rl.experiments.jobs import Job, run_jobs


class Diary:
    """Work that writes down what it does and fails where its argument says so."""

    def __init__(self):
        self.done = []

    def __call__(self, argument):
        self.done.append(argument)
        if argument.startswith("raise"):
            raise RuntimeError("a defect")
        return "my reason" if argument.startswith("fail") else None


def test_jobs_are_done_in_order_and_after_what_they_wait_for():
    work = Diary()
    todo = [Job("a", "a", "c"), Job("b", "b"), Job("c", "c", "b"), Job("d", "d", "elsewhere")]
    ended = []
    failures = run_jobs(todo, work, workers=0, on_done=lambda *how: ended.append(how))
    assert failures == {}
    assert work.done == ["b", "c", "a", "d"]
    assert ended == [("b", None), ("c", None), ("a", None), ("d", None)]


def test_a_failing_job_stops_only_who_waits_for_it():
    work = Diary()
    todo = [
        Job("1", "fail"),
        Job("2", "two", "1"),
        Job("3", "three", "2"),
        Job("4", "raise"),
        Job("5", "five"),
    ]
    ended = []
    failures = run_jobs(todo, work, workers=0, on_done=lambda name, _: ended.append(name))
    assert work.done == ["fail", "raise", "five"]
    assert failures == {
        "1": "my reason",
        "2": "1 failed, which it needs",
        "3": "2 failed, which it needs",
        "4": "RuntimeError: a defect",
    }
    assert sorted(ended) == ["1", "2", "3", "4", "5"]


def test_nothing_to_do():
    assert run_jobs([], Diary(), workers=0) == {}


def test_the_number_of_workers_is_checked():
    with pytest.raises(ValueError, match="workers must be at least 0, got -1"):
        run_jobs([], Diary(), workers=-1)


def test_jobs_in_a_circle():
    circle = [Job("a", "a", "b"), Job("b", "b", "a"), Job("c", "c")]
    with pytest.raises(ValueError, match=r"in a circle: \['a', 'b'\]"):
        run_jobs(circle, Diary(), workers=0)


# Functions of the standard library, which a worker can import from anywhere.


def test_errors_come_back_from_other_processes():
    todo = [Job("fine", 0), Job("fails", -1), Job("late", 0, "fine")]
    others = set(multiprocessing.active_children())
    assert run_jobs(todo, time.sleep, workers=2) == {
        "fails": "ValueError: sleep length must be non-negative"
    }
    assert set(multiprocessing.active_children()) <= others


def test_a_killed_worker_is_replaced():
    failures = run_jobs([Job("a", 1), Job("b", 1)], os._exit, workers=1)
    assert failures.keys() == {"a", "b"}
    assert "its process was killed" in failures["b"]


SCRIPT = """
import signal, time
from popl_rl.experiments.jobs import Job, run_jobs

if __name__ == "__main__":
    # Whoever runs tests in the background has told them to ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    run_jobs([Job("first", 0.01), Job("long", 60)], time.sleep, workers=1,
             on_done=lambda *_: print("begun", flush=True))
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_leave_with_their_parent(how, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert parent.stdout.readline() == "begun\n"
    parent.send_signal(how)
    # Both pipes stay open for as long as a worker lives.
    _, errors = parent.communicate(timeout=20)
    assert parent.returncode != 0
    assert errors.count("Traceback") == (how == signal.SIGINT), errors
