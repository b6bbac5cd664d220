"""How time and memory of selection and of scoring grow with members and cases.

    python tests/benchmarks/growth.py --out FOLDER

Writes growth.csv and growth.png. Selection: 1000 parents from random passes, all members distinct.
Scoring: policies 8-64-64-4 of discrete actions, on as many segments of 20 steps as there are cases,
with 200 distinct observations. Memory is what the process takes beyond the input, with the result,
as Linux counts it; combinations that would need more than 2 GiB of input or result are left out.
"""

import argparse
import ctypes
import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.scoring import segment_scores
from popl_rl.plotting.style import PALETTE, save
from popl_rl.selection.lexicase import lexicase_selection

MEMBERS = (100, 1000, 10_000)
CASES = (1000, 10_000, 100_000)
COLOURS = dict(zip(MEMBERS, (PALETTE["blue"], PALETTE["orange"], PALETTE["green"]), strict=True))
MARKERS = dict(zip(MEMBERS, "os^", strict=True))
MEASURES = {"seconds": "processor time (s)", "mib": "memory beyond the input (MiB)"}
WORK = {"selection": "Selecting 1000 parents", "scoring": "Scoring segments of 20 steps"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    for prepare in (selection, scoring):
        prepare(10, 10)()  # what the first call ever takes is no matter of size
    rows = []
    for (work, prepare), members, cases in itertools.product(
        (("selection", selection), ("scoring", scoring)), MEMBERS, CASES
    ):
        if members * cases * (1 if work == "selection" else 4) > 2**31:
            continue
        seconds, mib = measure(prepare(members, cases))
        rows.append(
            {"work": work, "members": members, "cases": cases, "seconds": seconds, "mib": mib}
        )
        print(f"{work:10} {members:6} x {cases:7} {seconds:8.4f} s {mib:8.1f} MiB")  # noqa: T201
    table = pd.DataFrame(rows)
    table.to_csv(out / "growth.csv", index=False)
    save(picture(table), out / "growth.png")


def selection(members: int, cases: int) -> Callable[[], object]:
    passes = torch.empty(members, cases, dtype=torch.bool)
    passes.random_(generator=torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    return lambda: lexicase_selection(passes, 1000, generator=generator)


def scoring(members: int, cases: int) -> Callable[[], object]:
    generator = torch.Generator().manual_seed(0)
    spec = PolicySpec(8, 4, True, (64, 64))
    few = Population.create(spec, 100, generator=generator)
    population = few.subset(torch.arange(members) % 100)  # who they are makes no difference
    bank = SegmentBank(
        torch.randn(200, 8, generator=generator),
        torch.randint(200, (cases, 20), generator=generator),
        torch.randint(4, (cases, 20), generator=generator),
        True,
    )
    return lambda: segment_scores(population, bank)


def measure(run: Callable[[], object]) -> tuple[float, float]:
    """Least processor time of up to five runs in two seconds, and most memory of the first."""
    ctypes.CDLL(None).malloc_trim(0)  # memory freed but not given back would hide new use
    Path("/proc/self/clear_refs").write_text("5")
    before = status("VmRSS")
    times: list[float] = []
    mib = 0.0
    while len(times) < 5 and sum(times) < 2:
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
        mib = mib or status("VmHWM") - before
    return min(times), mib


def status(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(field))


def exponents(table: pd.DataFrame, column: str) -> tuple[float, float]:
    """Powers of members and of cases in ``column``, by least squares on logarithms."""
    known = table[table[column] > 0]
    design = np.column_stack([np.ones(len(known)), np.log(known[["members", "cases"]])])
    fit = np.linalg.lstsq(design, np.log(known[column]), rcond=None)[0]
    return float(fit[1]), float(fit[2])


def picture(table: pd.DataFrame) -> Figure:
    fig = Figure(figsize=(10.5, 7.2), layout="constrained")
    fig.suptitle("How time and memory grow, on one thread", fontsize=13)
    grid = fig.subplots(2, 2, sharex=True)
    for row, (work, title) in zip(grid, WORK.items(), strict=True):
        some = table[table["work"] == work]
        for axis, (column, label) in zip(row, MEASURES.items(), strict=True):
            lines(axis, some, column)
            by_members, by_cases = exponents(some, column)
            axis.set_title(
                f"{title}\nmembers$^{{{by_members:.2f}}}$ · cases$^{{{by_cases:.2f}}}$", fontsize=11
            )
            axis.set_ylabel(label)
    for axis in grid[1]:
        axis.set_xlabel("cases (selection) or segments (scoring)")
    grid[0, 0].legend(title="members", frameon=False, fontsize=9)
    return fig


def lines(axis: Axes, table: pd.DataFrame, column: str) -> None:
    for members, some in table.groupby("members"):
        axis.loglog(
            some["cases"],
            some[column].clip(lower=0.1 if column == "mib" else 1e-5),
            color=COLOURS[members],
            marker=MARKERS[members],
            label=f"{members:,}",
        )
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
