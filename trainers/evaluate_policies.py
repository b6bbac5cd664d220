"""Evaluate the policies of a finished run again: ``popl-evaluate``.

Everything is as the run's ``config.yaml`` says, but for what is given. Unless a seed is given,
held-out pairs, new raters and episodes are others than the run's own; the run's seed gives its own
again, and with it the same rows of ``results.csv`` (without those of B-REX and DPL, which are not
kept).

Where real people judge, they are the people that the run held out, and other answers of each are
told; with the run's seed the same.

popl-evaluate run_dir=runs/<name>                         # as the run did, other raters
popl-evaluate run_dir=runs/<name> evaluation.answers=5    # cater from five answers
popl-evaluate run_dir=runs/<name> seed=1 evaluation.episodes=1000 workers=auto
popl-evaluate run_dir=runs/<name> people.curve=[0,5,50]   # of a run on real people's answers
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import OmegaConf

from popl_rl.config import Checker, Config, EvaluateConfig, check_workers, plain, validate
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.interruption import importing
from popl_rl.processes import workers_for
from popl_rl.trainers.command import register_schemas, run_command

if TYPE_CHECKING:
    from popl_rl.evaluation.results import Scoreboard


def run(config: EvaluateConfig) -> tuple[Path, "Scoreboard"]:
    """Evaluate again; returns the folder that was written and the scoreboard."""
    problems: list[str] = []
    Checker("", problems).seed(config)
    check_workers(config.workers, Checker("", problems))
    if problems:
        raise ValueError("; ".join(problems))
    run_dir = Path(config.run_dir)
    stored = _settings(config, run_dir, has_data=(run_dir / "data").is_dir())
    seed = stored.seed + 1 if config.seed is None else config.seed
    # Imported late, so that a wrong setting is told at once.
    with importing():
        from popl_rl.experiments.people_reevaluation import evaluate_people_again
        from popl_rl.experiments.reevaluation import evaluate_again

    if not stored.raters.groups:
        return evaluate_people_again(stored, run_dir, seed=seed)
    with workers_for(config.workers, threads=stored.threads) as workers:
        return evaluate_again(stored, run_dir, seed=seed, workers=workers)


def _settings(config: EvaluateConfig, run_dir: Path, *, has_data: bool) -> Config:
    """The run's settings with what is given in their place, checked."""
    settings: Any = OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run_dir))
    # Baselines, and data if they were saved, are in the run's folder by now.
    settings.evaluation.baselines_from = None
    of_people = not settings.raters.groups
    if has_data and not of_people:
        settings.data.load = None
    given = {name: _given(config, name) for name in ("evaluation", "people")}
    _check_sections(given, of_people=of_people)
    for name, values in given.items():
        settings[name] = OmegaConf.merge(settings[name], values)
    found: Config = plain(settings)
    validate(found)
    return found


def _given(config: EvaluateConfig, section: str) -> dict[str, Any]:
    """What was given of a section, by name.

    As a plain dictionary: between two configurations of one class, unknown names would pass.
    """
    asked = OmegaConf.structured(config)[section]
    return {name: asked[name] for name in asked if not OmegaConf.is_missing(asked, name)}


def _check_sections(given: Mapping[str, Mapping[str, Any]], *, of_people: bool) -> None:
    """Raise for settings that the kind of run does not read."""
    if given["people"] and not of_people:
        raise ValueError(
            f"people.{next(iter(given['people']))} is for runs that real people judge, and "
            "simulated raters judge this one; settings of evaluation, such as "
            "evaluation.answers=5, are for these"
        )
    if given["evaluation"] and of_people:
        raise ValueError(
            f"evaluation.{next(iter(given['evaluation']))} is for runs that simulated raters "
            "judge, and real people judge this one; give the numbers of their answers that are "
            "told, such as people.curve=[0,5], or people.repeats"
        )
    fixed = [name for name in given["people"] if name not in ("curve", "repeats")]
    if fixed:
        raise ValueError(
            f"people.{fixed[0]} says from whom a run learns and who judges, which is over; only "
            "people.curve and people.repeats may differ from the run's, or train again"
        )


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="evaluate")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    folder, board = run(cfg)
    from rich.console import Console

    from popl_rl.experiments.report import print_results

    console = Console()
    print_results(console, board.results, board.label)
    console.print(f"written to {folder}", soft_wrap=True)


def cli() -> None:
    """Console command ``popl-evaluate``."""
    run_command(main, EvaluateConfig)


if __name__ == "__main__":
    cli()
