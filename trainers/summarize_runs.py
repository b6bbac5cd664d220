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

from popl_rl.evaluation.method_names import method_name
from popl_rl.evaluation.statistics import HEADLINES, headline_measure, read_results, summary
from popl_rl.experiments.report import results_table
from popl_rl.trainers.terminal import steady_terminal


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
    runs = {str(folder): read_results(folder / "results.csv") for folder in folders}
    console = Console()
    together = pd.concat(runs.values())
    console.print(results_table(together))
    measure = headline_measure(together)
    table = Table(title=f"The group served worst, over {len(runs)} runs (mean ± 95 % interval)")
    worst = f"worst group's {HEADLINES[measure]}"
    for name in ("method", worst, "lowest run", "accuracy behind the oracle"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for row in summary(runs, measure=measure).to_dict("records"):
        mean, half, low = (row[f"worst_{measure}{what}"] for what in ("", "_ci", "_min"))
        gap = f"at most {row['accuracy_gap']:.3f}"
        name = method_name(row["method"], row["choice"])
        table.add_row(name, f"{mean:.2f} ± {half:.2f}", f"{low:.2f}", gap)
    console.print(table)
    return 0


def cli() -> None:
    """Console command ``popl-summarize``."""
    with steady_terminal():
        sys.exit(main())


if __name__ == "__main__":
    cli()
