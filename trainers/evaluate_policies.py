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
from typing import Any

import hydra
import torch
from omegaconf import OmegaConf
from rich.console import Console

from popl_rl.config import Config, EvaluateConfig, validate
from popl_rl.evaluation.diagnostics import alarm, diagnostics
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.builders import build_spec
from popl_rl.experiments.data import build_groups, build_world, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.report import markdown, results_table
from popl_rl.experiments.run_folder import load_config, save_config
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_set import RewardSet
from popl_rl.models.sets import load_set
from popl_rl.storage import write_atomic, written_beside
from popl_rl.trainers.command import register_schemas, run_command


def run(config: EvaluateConfig) -> tuple[Path, Scoreboard]:
    """Evaluate again; returns the folder that was written and the scoreboard."""
    run_dir = Path(config.run_dir)
    kept = run_dir / "data"
    stored = _settings(config, run_dir, has_data=kept.is_dir())
    seed = stored.seed + 1 if config.seed is None else config.seed
    torch.set_num_threads(stored.threads)
    is_reward = (run_dir / RewardSet.folder).is_dir()
    found = load_set(run_dir / (RewardSet if is_reward else PolicySet).folder)
    base_path = run_dir / "baselines"
    baselines = None
    if stored.evaluation.baselines and base_path.is_dir():
        baselines = load_set(base_path)
    world = build_world(stored.env)
    groups = build_groups(stored.raters, world)
    given = None if stored.data.load is None else Path(stored.data.load)
    data = make_data(
        stored.data,
        stored.raters,
        world,
        groups,
        seed=stored.seed,
        env=stored.env,
        load=kept if kept.is_dir() else given,
    )
    spec = build_spec(stored.method, world.env)
    path = run_dir / "clone"
    clone = load_set(path) if path.is_dir() else None
    evaluator = make_evaluator(stored, world, groups, data, spec, clone=clone, seed=seed)
    board = evaluator.score(found, baselines, label=stored.method.name)
    number = 1 + len(list((run_dir / "evaluations").glob("[0-9]*")))
    folder = run_dir / "evaluations" / f"{number:03d}"
    used = {"run_dir": str(config.run_dir), "evaluation": stored.evaluation, "seed": seed}
    title = f"Evaluation {number} of {run_dir.name}"
    about = {
        "answers of each new rater": stored.evaluation.answers,
        "seed": seed,
        **diagnostics(board, evaluator),
    }
    report = markdown(board.results, title=title, about=about, figures=[])
    with written_beside(folder) as beside:
        save_config(beside, used)
        write_atomic(beside / "results.csv", board.results.to_csv(index=False))
        write_atomic(beside / "report.md", report)
    return folder, board


def _settings(config: EvaluateConfig, run_dir: Path, *, has_data: bool) -> Any:
    """The run's settings with what is given in their place, checked."""
    settings: Any = OmegaConf.merge(OmegaConf.structured(Config), load_config(run_dir))
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
    console = Console()
    console.print(results_table(board.results))
    warning = alarm(board.results)
    if warning is not None:
        console.print(f"alarm: {warning}", style="bold red", highlight=False, soft_wrap=True)
    console.print(f"written to {folder}", soft_wrap=True)


def cli() -> None:
    """Console command ``popl-evaluate``."""
    run_command(main)


if __name__ == "__main__":
    cli()
