"""Train a policy set and show what it is worth: ``popl-train``.

popl-train                                          # two doors, half of the raters want each
popl-train raters=minority seed=3 run_dir=runs/mine
popl-train env=metaworld/drawer_open
popl-train resume=runs/mine                         # goes on where it was killed
popl-train -m seed=0,1,2,3,4

It collects segments, has hidden groups of raters compare them, evolves a population of policies,
and shows what the set is worth to every hidden group beside pooled CPL and the oracle.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra

from popl_rl.config import Config
from popl_rl.trainers.command import prepare, register_schemas, run_command

if TYPE_CHECKING:
    from popl_rl.evaluation.results import Scoreboard
    from popl_rl.models.hypothesis_set import HypothesisSet


@dataclass(frozen=True)
class Result:
    """What a run leaves behind.

    Attributes:
        run_dir: Folder of the run.
        policies: The set that was found.
        board: What it is worth to every group.
    """

    run_dir: Path
    policies: "HypothesisSet"
    board: "Scoreboard"


def run(config: Config) -> Result:
    """Train, or go on where a killed run was stopped."""
    config = prepare(config)
    # Imported late, so that a wrong setting is told at once.
    from popl_rl.experiments import steps

    config, run_dir = steps.open_run(config, command=sys.argv)

    # 1. World, raters, and what they say.
    setting = steps.gather(config, run_dir)

    # 2. The population, evolved.
    with steps.open_logger(config, run_dir) as logger:
        method = steps.build(config, setting)
        found = steps.evolve(config, setting, method, run_dir, logger)

        # 3. What the set is compared with, on the same data and by the same recipe.
        references = steps.train_references(config, setting, run_dir)

        # 4. Evaluated for every hidden group; told in a table, in pictures and in words.
        board = steps.evaluate(config, setting, found, references, run_dir)
        figures = steps.draw(config, setting, found, references, board, run_dir)
        steps.log_results(logger, board, figures, method.generations)
    steps.write_report(config, setting, found, board, figures, run_dir)
    return Result(run_dir, found, board)


def show(result: Result) -> None:
    """Print the table and where everything is."""
    from rich.console import Console

    from popl_rl.evaluation.diagnostics import alarm
    from popl_rl.experiments.report import results_table

    console = Console()
    console.print(results_table(result.board.results))
    warning = alarm(result.board.results)
    if warning is not None:
        console.print(f"alarm: {warning}", style="bold red", highlight=False, soft_wrap=True)
    console.print(f"report, pictures, policies and logs: {result.run_dir}", soft_wrap=True)


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="train")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    config = prepare(cfg)
    method, env = config.method.name, config.env.factory
    # Loading PyTorch takes seconds, in which a person should know that something goes on.
    sys.stderr.write(f"{method} in {env}, seed {config.seed}: loading PyTorch\n")
    show(run(config))


def cli() -> None:
    """Console command ``popl-train``."""
    run_command(main)


if __name__ == "__main__":
    cli()
