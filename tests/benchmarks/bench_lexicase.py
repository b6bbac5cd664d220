"""Speed of lexicase selection beside the PyPI package lexicase, and how it grows.

    pytest tests/benchmarks/bench_lexicase.py -m benchmark

Both run on one thread, in turns, so that whatever else the machine does burdens both. Tables go to
the terminal, the plot to pytest's temporary folder (choose it with --basetemp).
"""

import ctypes
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lexicase as reference
import matplotlib as mpl
import numpy as np
import pytest
import torch
from torch import Tensor

from popl_rl.lexicase import lexicase_report, lexicase_selection

mpl.use("agg")
from matplotlib import pyplot as plt

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

Say = Callable[[str], None]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def say(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> Say:
    def write(line: str) -> None:
        with capsys.disabled():
            request.config.get_terminal_writer().line(line)

    write("")
    return write


def seconds(run: Callable[[], object], number: int = 1) -> float:
    """Processor time, not the clock's: what others run at the same time counts for less."""
    start = time.process_time()
    for _ in range(number):
        run()
    return (time.process_time() - start) / number


def race(
    say: Say,
    title: str,
    ours: Callable[[], object],
    theirs: Callable[[], object],
    *,
    rounds: int,
    target: float,
    scale: float = 1.0,
    number: int = 1,
) -> float:
    """Time both in turns, ``number`` runs each, and return the median ratio.

    ``scale`` multiplies their time, where they were given fewer selections.
    """
    ours()
    theirs()
    pairs = [(seconds(ours, number), scale * seconds(theirs, number)) for _ in range(rounds)]
    (low, middle), (low_ref, middle_ref) = (
        (min(times), statistics.median(times)) for times in zip(*pairs, strict=True)
    )
    ratio = statistics.median(their_time / our_time for our_time, their_time in pairs)
    say(
        f"{title}: ours {low:.4g} s (median {middle:.4g}), lexicase {reference.__version__} "
        f"{low_ref:.4g} s (median {middle_ref:.4g}); ratio of minima {low_ref / low:.1f}, "
        f"of medians {middle_ref / middle:.1f}, median of ratios {ratio:.1f}, target {target:g}"
    )
    return ratio


def coin_flips(members: int, cases: int, seed: int = 0) -> Tensor:
    passes = torch.empty(members, cases, dtype=torch.bool)
    return passes.random_(generator=torch.Generator().manual_seed(seed))


def test_distinct_behaviours(say: Say) -> None:
    passes = coin_flips(1000, 100_000)
    generator = torch.Generator().manual_seed(1)
    ratio = race(
        say,
        "1000 selections, 1000 x 100 000 passes, all distinct",
        lambda: lexicase_selection(passes, 1000, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 1000),
        rounds=7,
        target=15,
    )
    assert ratio > 15


def test_twenty_behaviours(say: Say) -> None:
    draws = torch.Generator().manual_seed(1)
    passes = coin_flips(20, 100_000)[torch.randint(20, (1000,), generator=draws)]
    ratio = race(
        say,
        "the same with 20 distinct behaviours (reference: 2 selections, times 500)",
        lambda: lexicase_selection(passes, 1000, generator=draws),
        lambda: reference.lexicase_selection(passes.numpy(), 2),
        rounds=3,
        target=500,
        scale=500,
    )
    assert ratio > 500


def test_small_population(say: Say) -> None:
    passes = coin_flips(100, 2048)
    generator = torch.Generator().manual_seed(1)
    ratio = race(
        say,
        "100 selections, 100 x 2048 passes",
        lambda: lexicase_selection(passes, 100, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 100),
        rounds=21,
        target=10,
        number=20,
    )
    # About 250 calls into torch take a millisecond, however small their tensors.
    assert ratio > 4


def test_median_absolute_deviation(say: Say) -> None:
    generator = torch.Generator().manual_seed(1)
    scores = torch.randn(1000, 20_000, generator=generator)
    ratio = race(
        say,
        "1000 selections, 1000 x 20 000 real scores, epsilon='mad'",
        lambda: lexicase_selection(scores, 1000, epsilon="mad", generator=generator),
        lambda: reference.epsilon_lexicase_selection(scores.numpy(), 1000),
        rounds=7,
        target=10,
    )
    # 3700 deviations are needed, at two medians of 1000 values each.
    assert ratio > 4


@pytest.mark.parametrize("share", [0.7, 0.9, 0.99])
def test_most_cases_passed(say: Say, share: float) -> None:
    generator = torch.Generator().manual_seed(1)
    passes = torch.rand(1000, 20_000, generator=generator) < share
    race(
        say,
        f"1000 selections, 1000 x 20 000 passes, {share:.0%} passed (reference: 100, times 10)",
        lambda: lexicase_selection(passes, 1000, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 100),
        rounds=3,
        target=1,
        scale=10,
    )


def test_siblings(say: Say) -> None:
    """Every member has a sibling that differs in 10 of 20 000 cases, as after a small mutation."""
    generator = torch.Generator().manual_seed(1)
    passes = coin_flips(500, 20_000)
    siblings = passes.clone()
    flips = torch.randint(20_000, (500, 10), generator=generator)
    siblings.scatter_(1, flips, ~siblings.gather(1, flips))
    passes = torch.cat([passes, siblings])
    race(
        say,
        "1000 selections, 500 pairs of siblings x 20 000 passes (reference: 10, times 100)",
        lambda: lexicase_selection(passes, 1000, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 10),
        rounds=3,
        target=1,
        scale=100,
    )


def test_growth(say: Say, tmp_path: Path) -> None:
    """Time and memory of 1000 selections over members and cases, with fitted exponents."""
    members, cases = [100, 1000, 10_000], [1000, 10_000, 100_000]
    rows: list[tuple[int, int, float, float, float]] = []
    say("members   cases   seconds   extra MiB   mean depth")
    for number in members:
        for width in cases:
            passes = coin_flips(number, width)
            generator = torch.Generator().manual_seed(1)
            times, depth, extra = [], 0.0, 0.0
            for _ in range(3):
                before = reset_peak()
                start = time.process_time()
                report = lexicase_report(passes, 1000, generator=generator)
                times.append(time.process_time() - start)
                extra = max(extra, peak() - before)
                depth = float(report.depth.double().mean())
            rows.append((number, width, min(times), extra, depth))
            say(f"{number:7d} {width:7d} {min(times):9.4f} {extra:11.1f} {depth:12.1f}")
    table = np.array(rows)
    design = np.stack([np.ones(len(table)), *np.log(table[:, :2]).T], axis=1)
    for name, column in (("time", table[:, 2]), ("memory", table[:, 3])):
        known = column > 0
        fit = np.linalg.lstsq(design[known], np.log(column[known]), rcond=None)[0]
        say(f"{name} grows as members ^ {fit[1]:.2f} * cases ^ {fit[2]:.2f}")

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    for axis, column, label in zip(axes, (2, 3), ("seconds", "extra MiB"), strict=True):
        for number in members:
            line = table[table[:, 0] == number]
            axis.loglog(line[:, 1], np.maximum(line[:, column], 1e-3), "o-", label=f"{number}")
        axis.set(xlabel="cases", ylabel=f"{label} for 1000 selections")
    axes[0].legend(title="members")
    figure.savefig(tmp_path / "lexicase_growth.png", dpi=150)
    plt.close(figure)
    say(f"plot: {tmp_path / 'lexicase_growth.png'}")


def reset_peak() -> float:
    """Forget the process's peak memory and return what it uses now, in MiB (Linux with glibc)."""
    if Path("/proc/self/clear_refs").exists():
        ctypes.CDLL(None).malloc_trim(0)  # memory freed but not given back would hide new use
        Path("/proc/self/clear_refs").write_text("5")
    return status("VmRSS")


def peak() -> float:
    return status("VmHWM")


def status(field: str) -> float:
    file = Path("/proc/self/status")
    lines = file.read_text().splitlines() if file.exists() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(field)), 0.0)
