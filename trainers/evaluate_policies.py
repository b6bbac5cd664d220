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
from popl_rl.experiment import build_groups, build_spec, label_of, make_data
from popl_rl.policy_set import PolicySet, RewardSet, load_set
from popl_rl.report import markdown, results_table
from popl_rl.results import Scoreboard, make_judge
from popl_rl.runs import load_config, save_config, write_atomic
from popl_rl.trainers.command import register_schemas, run_command
from popl_rl.worlds import build_world


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
    # What it was trained with decides, whatever is asked for now.
    path = run_dir / "reference"
    reference = load_set(path) if path.is_dir() else None
    judge = make_judge(stored, world, groups, data, spec, reference=reference, seed=config.seed)
    board = judge.score(found, baselines, label=label_of(stored.method))
    number = 1 + len(list((run_dir / "evaluations").glob("[0-9]*")))
    folder = run_dir / "evaluations" / f"{number:03d}"
    beside = folder.with_name(f".{folder.name}")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    save_config(beside, OmegaConf.structured(config))
    write_atomic(beside / "results.csv", board.results.to_csv(index=False))
    title = f"Evaluation {number} of {run_dir.name}"
    about = {"answers of each new rater": config.evaluation.answers, "seed": config.seed}
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
    console.print(f"written to {folder}", soft_wrap=True)


def cli() -> None:
    """Console command ``popl-evaluate``."""
    run_command(main)


if __name__ == "__main__":
    cli()
