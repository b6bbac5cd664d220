"""Count what sets guarantee: ``python -m popl_rl.trainers.measure_guarantees``.

popl-benchmark suite=guarantees
python -m popl_rl.trainers.measure_guarantees runs/benchmark-guarantees  # rows, then the figure
python -m popl_rl.trainers.measure_guarantees                            # the figure alone
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from popl_rl.storage import write_atomic
from popl_rl.trainers.command import USER_ERRORS

_SCENARIOS = {"three_groups": "three groups", "ring_12": "12 groups"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the cells of a benchmark, draw the figure; returns the exit code."""
    parser = argparse.ArgumentParser("measure_guarantees", description=__doc__.splitlines()[0])
    parser.add_argument("benchmark", nargs="?", type=Path, help="folder of popl-benchmark")
    parser.add_argument("--root", type=Path, default=Path(), help="the checkout; default: here")
    given = parser.parse_args(arguments)
    kept = given.root / "configs" / "results" / "guarantees.csv"
    try:
        from popl_rl.experiments.guarantees import guarantee_rows
        from popl_rl.plotting.guarantee_plots import guarantee_curves
        from popl_rl.plotting.style import save

        if given.benchmark is not None:
            rows = guarantee_rows(given.benchmark)
            write_atomic(kept, rows.to_csv(index=False, float_format="%.4f"))
        fig = guarantee_curves(pd.read_csv(kept), _SCENARIOS)
        save(fig, given.root / ".assets" / "guarantees.png")
    except USER_ERRORS as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
