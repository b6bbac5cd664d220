"""Judge the policies of a finished run again: ``popl-evaluate``.

popl-evaluate run_dir=runs/<name>                         # as the run did, other raters
popl-evaluate run_dir=runs/<name> evaluation.answers=5    # cater from five answers
popl-evaluate run_dir=runs/<name> seed=1 evaluation.episodes=1000
"""

import shutil
from pathlib import Path
from typing import Any

import hydra
from omegaconf import OmegaConf
from rich.console import Console

from popl_rl.config import Config, EvaluateConfig, validate
from popl_rl.data.environments import build_world
from popl_rl.evaluation.diagnostics import alarm, diagnostics
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.builders import build_spec
from popl_rl.experiments.data import build_groups, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.report import markdown, results_table
from popl_rl.experiments.run_folder import load_config, save_config
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_set import RewardSet
from popl_rl.models.sets import load_set
from popl_rl.storage import write_atomic
from popl_rl.trainers.command import register_schemas, run_command


def run(config: EvaluateConfig) -> tuple[Path, Scoreboard]:
    """Judge again; returns the folder that was written and the scoreboard."""
    run_dir = Path(config.run_dir)
    stored: Any = OmegaConf.merge(OmegaConf.structured(Config), load_config(run_dir))
    stored.evaluation = config.evaluation
    validate(stored)
    is_reward = (run_dir / RewardSet.folder).is_dir()
    found = load_set(run_dir / (RewardSet if is_reward else PolicySet).folder)
    base_path = run_dir / "baselines"
    baselines = load_set(base_path) if base_path.is_dir() else None
    world = build_world(stored.env)
    groups = build_groups(stored.raters, world)
    kept = run_dir / "data"
    data = make_data(
        stored.data,
        stored.raters,
        world,
        groups,
        seed=stored.seed,
        env=stored.env,
        load=kept if kept.is_dir() else None,
    )
    spec = build_spec(stored.method, world.env)
    path = run_dir / "clone"
    clone = load_set(path) if path.is_dir() else None
    evaluator = make_evaluator(stored, world, groups, data, spec, clone=clone, seed=config.seed)
    board = evaluator.score(found, baselines, label=stored.method.name)
    number = 1 + len(list((run_dir / "evaluations").glob("[0-9]*")))
    folder = run_dir / "evaluations" / f"{number:03d}"
    beside = folder.with_name(f".{folder.name}")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    save_config(beside, OmegaConf.structured(config))
    write_atomic(beside / "results.csv", board.results.to_csv(index=False))
    title = f"Evaluation {number} of {run_dir.name}"
    about = {
        "answers of each new rater": config.evaluation.answers,
        "seed": config.seed,
        **diagnostics(board, evaluator),
    }
    report = markdown(board.results, title=title, about=about, figures=[])
    write_atomic(beside / "report.md", report)
    beside.rename(folder)
    return folder, board


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
