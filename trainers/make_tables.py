"""Write the tables of results in the README files: ``python -m popl_rl.trainers.make_tables``.

python -m popl_rl.trainers.make_tables                           # from configs/results/*.csv
python -m popl_rl.trainers.make_tables runs/benchmark-two_doors  # take its rows over first
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from popl_rl.experiments.tables import fill_tables, make_tables, read_tables, rows_for
from popl_rl.storage import write_atomic

_PAGES = ("README.md", "configs/README.md")


def main(arguments: Sequence[str] | None = None) -> int:
    """Take rows over, rewrite the tables; returns the exit code."""
    parser = argparse.ArgumentParser("make_tables", description=__doc__.splitlines()[0])
    parser.add_argument("benchmarks", nargs="*", type=Path, help="folders of popl-benchmark")
    parser.add_argument("--root", type=Path, default=Path(), help="the checkout; default: here")
    given = parser.parse_args(arguments)
    folder = given.root / "configs" / "results"
    try:
        tables = read_tables(folder / "tables.toml")
        for benchmark in given.benchmarks:
            rows = rows_for(tables, pd.read_csv(benchmark / "results.csv"))
            for suite, own in rows.groupby("suite"):
                text = own.to_csv(index=False, float_format="%.4f")
                write_atomic(folder / f"{suite}.csv", text)
        made = make_tables(tables, folder)
        for page in (given.root / name for name in _PAGES):
            write_atomic(page, fill_tables(page.read_text(encoding="utf-8"), made))
    except (OSError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
