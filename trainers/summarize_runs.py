"""Tables over several runs of one setting: ``popl-summarize runs/a runs/b ...``.

popl-train -m seed=0,1,2,3,4 'run_dir=runs/two_groups/${seed}'
popl-summarize runs/two_groups/*
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.table import Table

from popl_rl.evaluation.statistics import summary
from popl_rl.experiments.report import results_table
from popl_rl.plotting.run_plots import method_name


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; returns the exit code."""
    parser = argparse.ArgumentParser(prog="popl-summarize", description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of finished runs")
    folders = parser.parse_args(arguments).runs
    unfinished = [str(folder) for folder in folders if not (folder / "results.csv").is_file()]
    if unfinished:
        Console(stderr=True).print(
            f"error: no results.csv in {', '.join(unfinished)}; name folders of finished runs, or "
            "finish them with resume=<folder>",
            soft_wrap=True,
        )
        return 2
    runs = {str(folder): pd.read_csv(folder / "results.csv") for folder in folders}
    console = Console()
    console.print(results_table(pd.concat(runs.values())))
    table = Table(title=f"The group served worst, over {len(runs)} runs (mean ± 95 % interval)")
    for name in ("method", "worst group's recovery", "lowest run", "accuracy behind the oracle"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for row in summary(runs).itertuples():
        recovery = f"{row.worst_recovery:.2f} ± {row.worst_recovery_ci:.2f}"
        lowest, gap = f"{row.worst_recovery_min:.2f}", f"at most {row.accuracy_gap:.3f}"
        table.add_row(method_name(str(row.method)), recovery, lowest, gap)
    console.print(table)
    return 0


def cli() -> None:
    """Console command ``popl-summarize``."""
    sys.exit(main())


if __name__ == "__main__":
    cli()
