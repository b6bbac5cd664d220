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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra

from popl_rl.accessories import accessory
from popl_rl.config import Config
from popl_rl.experiments.run_manifest import is_run_of
from popl_rl.interruption import importing
from popl_rl.trainers.command import given_overrides, prepare, register_schemas, run_command

if TYPE_CHECKING:
    from popl_rl.evaluation.results import Scoreboard
    from popl_rl.experiments.preflight import Place
    from popl_rl.models.hypothesis_set import HypothesisSet


@dataclass(frozen=True)
class Result:
    """What a run leaves behind.

    Attributes:
        run_dir: Folder of the run.
        policies: The set that was found.
        board: What it is worth to every group.
        missing: Says how many answers are missing, if any are.
    """

    run_dir: Path
    policies: "HypothesisSet"
    board: "Scoreboard"
    missing: str | None = None


def run(config: Config) -> Result:
    """Train, or go on where a killed run was stopped."""
    config = prepare(config)
    if _is_of_sweep(config):
        config = replace(config, resume=config.run_dir)
    is_new = config.resume is None
    # Imported late, so that a wrong setting is told at once.
    with importing():
        from popl_rl.experiments import steps

    opened = steps.open_run(config, command=sys.argv, given=given_overrides())
    with opened as (config, run_dir, place):
        if place is None:
            return _run_people(config, run_dir, is_new=is_new)
        return _run_groups(config, run_dir, place, is_new=is_new)


def _run_groups(config: Config, run_dir: Path, place: "Place", *, is_new: bool) -> Result:
    """Learn from simulated raters of hidden groups, and judge by what each group gets."""
    from popl_rl.experiments import steps
    from popl_rl.experiments.learning_curve import missing_answers

    # 1. World, raters, and what they say; the population to start from.
    with steps.kept_unless_refused(run_dir, is_new=is_new):
        setting = steps.gather(config, run_dir, place)
        method = steps.build(config, setting)

    # 2. The population, evolved.
    with steps.open_logger(config, run_dir) as logger:
        found = steps.evolve(config, setting, method, run_dir, logger)

        # 3. What the set is compared with, on the same data and by the same recipe.
        references = steps.train_references(config, setting, run_dir)

        # 4. Evaluated for every hidden group; told in a table, in pictures and in words.
        board = steps.evaluate(config, setting, found, references, run_dir)
        missing = missing_answers(config, setting, found, run_dir)
        about = steps.describe(config, setting, found, board)
        about |= {} if missing is None else {"answers": missing}
        steps.write_report(config, board, about, {}, run_dir)
        figures = steps.draw(config, setting, found, references, board, run_dir)
        steps.write_report(config, board, about, figures, run_dir)
        steps.log_results(logger, board, figures, method.generations)
    return Result(run_dir, found, board, missing)


def _run_people(config: Config, run_dir: Path, *, is_new: bool) -> Result:
    """Learn from real people's answers, and judge by people who were held out."""
    from popl_rl.evaluation.results import Scoreboard
    from popl_rl.experiments import people_steps, steps
    from popl_rl.experiments.run_sets import save_anew

    # 1. What people said, and who of them is held out.
    with steps.kept_unless_refused(run_dir, is_new=is_new):
        people = people_steps.read_people(config, run_dir)
        (fold,) = people_steps.make_folds(config, people, 1)

    # 2. The population, evolved.
    with steps.open_logger(config, run_dir) as logger:
        trained = people_steps.evolve_people(config, people, fold, run_dir, logger)
        assert trained.found is not None
        save_anew(trained.found, run_dir / trained.found.folder, run_dir)

    # 3. Judged by the people held out, beside one hypothesis for all and one for each person.
    table = people_steps.compare_methods(
        config,
        people,
        methods=[*people_steps.REFERENCES, config.method.name],
        folds=[fold],
        cells=run_dir / "cells",
        known=lambda name, _: trained if name == config.method.name else None,
    )
    title = f"{config.method.name} on real people"
    results = people_steps.finish_people(config, people, [fold], table, run_dir, title=title)
    return Result(run_dir, trained.found, Scoreboard(results, {}, {}, config.method.name))


def _is_of_sweep(config: Config) -> bool:
    """Whether this is a run of a sweep that was begun by a sweep before, which was killed."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    is_sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    if not is_sweep or config.run_dir is None or config.resume is not None:
        return False
    run_dir = Path(config.run_dir)
    return (run_dir / "config.yaml").is_file() and is_run_of(run_dir, config)


def show(result: Result) -> None:
    """Print the table and where everything is."""
    from rich.console import Console

    from popl_rl.experiments.report import print_results

    console = Console()
    print_results(console, result.board.results, result.board.label)
    if result.missing is not None:
        console.print(
            f"warning: {result.missing}", style="bold red", highlight=False, soft_wrap=True
        )
    console.print(f"report, pictures, policies and logs: {result.run_dir}", soft_wrap=True)


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="train")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    config = prepare(cfg)
    if _is_of_sweep(config):
        run_dir = Path(str(config.run_dir))
        if (run_dir / "report.md").is_file():
            print(f"{run_dir} is finished, and left as it is")
            return
    method = config.method.name
    env = config.env.factory if config.raters.groups else str(config.data.load)
    # Loading PyTorch takes seconds, in which a person should know that something goes on.
    sys.stderr.write(f"{method} in {env}, seed {config.seed}: loading PyTorch\n")
    result = run(config)
    with accessory("the table was not printed", f"see report.md in {result.run_dir}"):
        show(result)


def cli() -> None:
    """Console command ``popl-train``."""
    run_command(main)


if __name__ == "__main__":
    cli()
