"""Work and its reference, timed in turns on one thread.

Whatever else the machine does burdens both, and processor time rather than the clock's is counted.
"""

import ctypes
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from popl_rl.memory import keep_freed_memory

Say = Callable[[str], None]
Run = Callable[[], object]


class Race(Protocol):
    """What the fixture ``race`` is."""

    def __call__(
        self,
        title: str,
        ours: Run,
        theirs: Run,
        *,
        reference: str,
        target: float,
        rounds: int,
        scale: float = 1.0,
        number: int = 1,
    ) -> float: ...


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    keep_freed_memory()  # as runs do
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def say(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> Say:
    """Write a line to the terminal, whether or not output is captured."""

    def write(line: str) -> None:
        with capsys.disabled():
            request.config.get_terminal_writer().line(line)

    write("")
    return write


@pytest.fixture
def race(benchmark: BenchmarkFixture, say: Say) -> Race:
    """Time work and reference in turns, ``number`` runs each; the median of the rounds' ratios.

    ``scale`` multiplies the reference's time where it does only a part of the work.
    """

    def run(
        title: str,
        ours: Run,
        theirs: Run,
        *,
        reference: str,
        target: float,
        rounds: int,
        scale: float = 1.0,
        number: int = 1,
    ) -> float:
        ours()
        theirs()
        our_times: list[float] = []
        their_times: list[float] = []

        def prepare() -> None:
            their_times.append(scale * seconds(theirs, number))

        def work() -> None:
            our_times.append(seconds(ours, number))

        benchmark.pedantic(work, setup=prepare, rounds=rounds, iterations=1)
        ratios = sorted(one / two for one, two in zip(their_times, our_times, strict=True))
        ratio = statistics.median(ratios)
        benchmark.extra_info.update(
            reference=reference, ratio=ratio, lowest=ratios[0], highest=ratios[-1], target=target
        )
        say(
            f"{title}: {statistics.median(our_times):.4g} s, {reference} "
            f"{statistics.median(their_times):.4g} s; ratio {ratio:.3g} "
            f"({ratios[0]:.3g} to {ratios[-1]:.3g} in {rounds} rounds), target {target:g}"
        )
        return ratio

    return run


def seconds(run: Run, number: int = 1) -> float:
    """Processor time of a run."""
    start = time.process_time()
    for _ in range(number):
        run()
    return (time.process_time() - start) / number


@pytest.fixture
def extra_memory() -> Callable[[Run], float]:
    """Most memory that a run takes beyond what the process has, in MiB (Linux with glibc)."""

    def measure(run: Run) -> float:
        if not Path("/proc/self/clear_refs").exists():
            return float("nan")
        ctypes.CDLL(None).malloc_trim(0)  # memory freed but not given back would hide new use
        Path("/proc/self/clear_refs").write_text("5")
        before = status("VmRSS")
        run()
        return status("VmHWM") - before

    return measure


def status(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(field))
