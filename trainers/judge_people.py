"""Compare methods by real people, whose groups nobody knows: ``popl-people``.

popl-people data.load=my_data                                   # popl, em, vpl, pooled CPL, ...
popl-people data.load=comparisons.csv data.reader_options.items=items.csv
popl-people data.load=my_data people.methods=[popl] people.folds=3

The people are divided into folds. Each method learns from all but one fold and is told K answers of
each person of that one; how well it predicts that person's other answers is what counts. The same
command goes on after a kill.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra

from popl_rl.accessories import accessory
from popl_rl.config import Config
from popl_rl.interruption import importing
from popl_rl.trainers.command import given_overrides, prepare, register_schemas, run_command

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Result", "cli", "main", "run"]


@dataclass(frozen=True)
class Result:
    """What a comparison leaves behind.

    Attributes:
        run_dir: Its folder.
        results: Rows ``method, choice, group, measure, value``.
    """

    run_dir: Path
    results: "pd.DataFrame"


def run(config: Config) -> Result:
    """Compare methods on all folds, or go on where a killed comparison was stopped."""
    config = prepare(config)
    is_new = config.resume is None
    # Imported late, so that a wrong setting is told at once.
    with importing():
        from popl_rl.experiments import people_steps, steps

    opened = steps.open_run(config, command=sys.argv, given=given_overrides())
    with opened as (config, run_dir, _):
        with steps.kept_unless_refused(run_dir, is_new=is_new):
            people = people_steps.read_people(config, run_dir)
        told = ["oracle"] if any(people.groups) and config.method.ties == "drop" else []
        methods = [*people_steps.REFERENCES, *told, *config.people.methods]
        folds = people_steps.make_folds(config, people, config.people.folds)
        table = people_steps.compare_methods(
            config, people, methods=methods, folds=folds, cells=run_dir / "cells"
        )
        title = f"Real people: {', '.join(config.people.methods)}"
        results = people_steps.finish_people(config, people, folds, table, run_dir, title=title)
    return Result(run_dir, results)


def show(result: Result) -> None:
    """Print the table and where everything is."""
    from rich.console import Console

    from popl_rl.experiments.people_report import people_table

    console = Console()
    console.print(people_table(result.results))
    console.print(f"report, figure and every person's numbers: {result.run_dir}", soft_wrap=True)


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="people")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    result = run(cfg)
    with accessory("the table was not printed", f"see report.md in {result.run_dir}"):
        show(result)


def cli() -> None:
    """Console command ``popl-people``."""
    run_command(main)


if __name__ == "__main__":
    cli()
