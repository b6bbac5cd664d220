"""Evaluate the policies of a finished run again: ``popl-evaluate``.

Everything is as the run's ``config.yaml`` says, but for what is given. Unless a seed is given,
held-out pairs, new raters and episodes are others than the run's own; the run's seed gives its own
again, and with it the same rows of ``results.csv`` (without those of B-REX and DPL, which are not
kept).

popl-evaluate run_dir=runs/<name>                         # as the run did, other raters
popl-evaluate run_dir=runs/<name> evaluation.answers=5    # cater from five answers
popl-evaluate run_dir=runs/<name> seed=1 evaluation.episodes=1000
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import OmegaConf

from popl_rl.config import Checker, Config, EvaluateConfig, validate
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.interruption import importing
from popl_rl.trainers.command import register_schemas, run_command

if TYPE_CHECKING:
    from popl_rl.evaluation.results import Scoreboard


def run(config: EvaluateConfig) -> tuple[Path, "Scoreboard"]:
    """Evaluate again; returns the folder that was written and the scoreboard."""
    problems: list[str] = []
    Checker("", problems).seed(config)
    if problems:
        raise ValueError(problems[0])
    run_dir = Path(config.run_dir)
    stored = _settings(config, run_dir, has_data=(run_dir / "data").is_dir())
    seed = stored.seed + 1 if config.seed is None else config.seed
    # Imported late, so that a wrong setting is told at once.
    with importing():
        from popl_rl.experiments.reevaluation import evaluate_again

    return evaluate_again(stored, run_dir, seed=seed)


def _settings(config: EvaluateConfig, run_dir: Path, *, has_data: bool) -> Any:
    """The run's settings with what is given in their place, checked."""
    settings: Any = OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run_dir))
    # Baselines, and data if they were saved, are in the run's folder by now.
    settings.evaluation.baselines_from = None
    if has_data:
        settings.data.load = None
    # As a plain dictionary: between two configurations of one class, unknown names would pass.
    asked = OmegaConf.structured(config).evaluation
    given = {name: asked[name] for name in asked if not OmegaConf.is_missing(asked, name)}
    settings.evaluation = OmegaConf.merge(settings.evaluation, given)
    validate(settings)
    return settings


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="evaluate")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    folder, board = run(cfg)
    from rich.console import Console

    from popl_rl.evaluation.diagnostics import alarm
    from popl_rl.experiments.report import results_table, verdict_lines

    console = Console()
    for line in verdict_lines(board.results, board.label):
        console.print(line, soft_wrap=True)
    console.print(results_table(board.results))
    warning = alarm(board.results)
    if warning is not None:
        console.print(f"alarm: {warning}", style="bold red", highlight=False, soft_wrap=True)
    console.print(f"written to {folder}", soft_wrap=True)


def cli() -> None:
    """Console command ``popl-evaluate``."""
    run_command(main, EvaluateConfig)


if __name__ == "__main__":
    cli()
