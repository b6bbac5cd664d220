"""Judging a finished run again by the real people whom it has held out."""

from pathlib import Path

import pandas as pd
import torch

from popl_rl.config import Config
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.builders import build_problem
from popl_rl.experiments.people_steps import (
    REFERENCES,
    finish_people,
    make_folds,
    read_people,
)
from popl_rl.experiments.people_training import Trained, judge_fold, reference, set_predictors
from popl_rl.experiments.reevaluation import evaluation_title, new_evaluation
from popl_rl.experiments.run_sets import load_found_set
from popl_rl.models.sets import load_set

__all__ = ["evaluate_people_again"]


def evaluate_people_again(config: Config, run_dir: Path, *, seed: int) -> tuple[Path, Scoreboard]:
    """Judge the set that a run has found, beside what it was compared with, as training did.

    The people are those whom the run has held out: the set has learnt from all others.

    Args:
        config: The run's settings, with what is to differ in the section ``people``.
        run_dir: Folder of the run, whose answers are used again.
        seed: Seed of which of a person's answers are told; with the run's own, the same are.

    Returns:
        The folder that was written, ``evaluations/<number>``, and the scoreboard.

    Raises:
        FileNotFoundError: If the run has found no set yet.
        ValueError: If what the run has kept is damaged, or its set does not hold all that its
            method predicts by.
    """
    torch.set_num_threads(config.threads)
    name = config.method.name
    if {"vpl", "lore"} & set(config.method.sections()):
        raise ValueError(
            f"runs of method {name} on real people cannot be judged again: what it predicts a new "
            "person by (an encoder, or bases) is not in its set; judge it by popl-people with "
            f"people.methods=[{name}], in folds"
        )
    found = load_found_set(run_dir)
    people = read_people(config, run_dir)
    folds = make_folds(config, people, 1)
    problem = build_problem(config.method, people.spec, people.bank, folds[0].training)
    kept = []
    for each in REFERENCES:
        pooled = load_set(run_dir / "cells" / f"{each}-0")
        scale = pooled.alpha / problem.training.alpha
        kept.append(reference(each, pooled, people, problem, config, scale=scale))
    own = set_predictors(found, people, folds[0], alpha=problem.training.alpha)
    kept.append(Trained(name, own, found))
    table = pd.concat(
        [judge_fold(people, folds[0], each, config.people, seed=seed) for each in kept]
    )
    with new_evaluation(run_dir, people=config.people, seed=seed) as (folder, beside):
        results = finish_people(
            config, people, folds, table, beside, title=evaluation_title(folder)
        )
    return folder, Scoreboard(results, {}, {}, name)
