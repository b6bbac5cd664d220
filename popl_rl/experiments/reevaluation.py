"""Evaluating the policies of a finished run again, into a folder of its own in the run's folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch

from popl_rl.config import Config
from popl_rl.data.environments import World
from popl_rl.evaluation.diagnostics import diagnostics
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.builders import build_spec
from popl_rl.experiments.data import Data, build_groups, build_world, given_data, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.ppo_policies import check_ppo, ppo_policies, tell_cost
from popl_rl.experiments.report import markdown
from popl_rl.experiments.run_folder import save_config
from popl_rl.experiments.run_manifest import check_own_data
from popl_rl.experiments.run_sets import load_found_set, load_own_set
from popl_rl.locks import locked
from popl_rl.processes import Workers
from popl_rl.storage import write_atomic, written_beside

__all__ = ["Gathered", "evaluate_again", "evaluation_title", "gather_again", "new_evaluation"]


def evaluate_again(
    config: Config, run_dir: Path, *, seed: int, workers: Workers | None = None
) -> tuple[Path, Scoreboard]:
    """Evaluate what a run found by these settings.

    Args:
        config: The run's settings, with what is to differ in the section ``evaluation``.
        run_dir: Folder of the run, whose segments and preferences are used again.
        seed: Seed of the held-out pairs, new raters and episodes.
        workers: Processes that step the world side by side; this one if None.

    Returns:
        The folder that was written, ``evaluations/<number>``, and the scoreboard.

    Raises:
        FileNotFoundError: If the run has found no set yet.
        ValueError: If what the run has kept is damaged, or settings do not go together.
    """
    torch.set_num_threads(config.threads)
    found, baselines = load_found_set(run_dir), None
    if config.evaluation.baselines and (run_dir / "baselines").is_dir():
        baselines = load_own_set(run_dir, "baselines")
    world, _, evaluator = gather_again(config, run_dir, seed=seed, workers=workers)
    ppo = None
    if config.evaluation.ppo_reference:
        check_ppo("evaluation.ppo_reference", world.env)
        tell_cost(config.env, config.raters.groups, world.make)
        ppo = ppo_policies(config.env, config.raters.groups, world.make)
    board = evaluator.score(found, baselines, ppo=ppo, label=config.method.name)
    about = {
        "answers of each new rater": config.evaluation.answers,
        "seed": seed,
        **diagnostics(board, evaluator),
    }
    with new_evaluation(run_dir, evaluation=config.evaluation, seed=seed) as (folder, beside):
        title = evaluation_title(folder)
        report = markdown(board.results, title=title, about=about, figures=[], label=board.label)
        write_atomic(beside / "results.csv", board.results.to_csv(index=False))
        write_atomic(beside / "report.md", report)
    return folder, board


class Gathered(NamedTuple):
    """What a run was about, once more."""

    world: World
    data: Data
    evaluator: Evaluator


def gather_again(
    config: Config, run_dir: Path, *, seed: int, workers: Workers | None = None
) -> Gathered:
    """The world of a run, its segments and preferences, and an evaluator of them.

    Args:
        config: The run's settings.
        run_dir: Folder of the run; what it has not kept is made or read as it was then.
        seed: Seed of the held-out pairs, new raters and episodes.
        workers: Processes that step the world side by side; this one if None.

    Raises:
        ValueError: If what the run has kept is damaged, or settings do not go together.
    """
    kept = run_dir / "data"
    world = build_world(config.env, workers=workers)
    groups = build_groups(config.raters, world)
    load, reader = (kept, None) if kept.is_dir() else given_data(config.data)
    if kept.is_dir():
        check_own_data(run_dir)
    data = make_data(
        config.data,
        config.raters,
        world,
        groups,
        seed=config.seed,
        env=config.env,
        load=load,
        reader=reader,
    )
    spec = build_spec(config.method, world.env)
    clone = load_own_set(run_dir, "clone") if (run_dir / "clone").is_dir() else None
    evaluator = make_evaluator(config, world, groups, data, spec, clone=clone, seed=seed)
    return Gathered(world, data, evaluator)


@contextmanager
def new_evaluation(run_dir: Path, **settings: Any) -> Iterator[tuple[Path, Path]]:
    """The next folder ``evaluations/<number>`` of a run, with the settings that led to it.

    Yields:
        The folder, and another, which becomes it when all is written.
    """
    # Another process may evaluate the same run.
    with locked(run_dir / "evaluations"):
        number = 1 + len(list((run_dir / "evaluations").glob("[0-9]*")))
        folder = run_dir / "evaluations" / f"{number:03d}"
        with written_beside(folder) as beside:
            save_config(beside, {"run_dir": str(run_dir), **settings})
            yield folder, beside


def evaluation_title(folder: Path) -> str:
    """Heading of the report of an evaluation."""
    return f"Evaluation {int(folder.name)} of {folder.parents[1].name}"
