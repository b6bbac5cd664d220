"""What people on a delivery grid are given: returns and walks of catered members, by condition."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from popl_rl.config import Config
from popl_rl.data.tables import Table, policy_return, solve
from popl_rl.experiments.people import People, split
from popl_rl.experiments.people_training import catered_members
from popl_rl.keys import REWARD
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.sets import load_set

__all__ = [
    "Acting",
    "act_for_people",
    "exact_returns",
    "led_to",
    "step_scores",
]

_DISCOUNT = 0.99
_HORIZON = 60


@dataclass(frozen=True)
class Acting:
    """What members do on the grid.

    Attributes:
        returns: Rows ``method, person, group, member, fold, greedy, planned``: shares of the
            optimum by the grid's own reward (0: random steps), of acting greedily by the member's
            scores and of planning for them as rewards.
        policies: Planned action in each cell of the member that most people of a group are given in
            the first fold, ``[S]``, by group; of the hypothesis for all under ``pooled CPL``.
    """

    returns: pd.DataFrame
    policies: dict[str, Tensor]


def exact_returns(table: Table, score: Tensor) -> tuple[float, float]:
    """Shares of the optimum of acting by scores of steps.

    Args:
        table: The grid.
        score: Of each action in each cell, ``[S, A]``.

    Returns:
        Of the action with the highest score, as of an advantage; and of the plan that gets the
        most of them, as of a reward. 1 is the best possible, 0 is as good as random steps.
    """
    reward = table.steps[REWARD]
    optimal = _greedy(solve(table, reward, discount=_DISCOUNT)[0])
    planned = _greedy(solve(table, score.float(), discount=_DISCOUNT)[0])
    uniform = torch.full_like(score, 1 / score.shape[1])
    best, random, greedy, plan = (
        policy_return(table, each, reward, horizon=_HORIZON)
        for each in (optimal, uniform, _greedy(score), planned)
    )
    return (greedy - random) / (best - random), (plan - random) / (best - random)


def _greedy(score: Tensor) -> Tensor:
    return torch.nn.functional.one_hot(score.argmax(1), score.shape[1]).float()


@torch.no_grad()
def step_scores(found: HypothesisSet, grid: Any) -> Tensor:
    """Score of every action in every cell in each member's eyes, ``[N, S, A]``."""
    spec = found.population.spec
    if isinstance(spec, PolicySpec):
        seen = torch.from_numpy(grid.cell_features())
        output: Tensor = found.population(seen)
        table: Tensor = spec.table(output) * found.alpha
        return table
    features = torch.from_numpy(grid.step_features())
    flat: Tensor = found.population(features.flatten(0, 1))
    scores: Tensor = flat[..., 0].unflatten(1, features.shape[:2]) * found.alpha
    return scores


def act_for_people(
    config: Config, people: People, grid: Any, cells: Path, *, answers: int = 20
) -> Acting:
    """Returns of what every held-out person is given after some answers.

    Args:
        config: Settings of the comparison.
        people: Everybody.
        grid: The delivery grid, see ``envs/delivery.py``.
        cells: Folder in which the comparison has kept its sets.
        answers: Answers that are told.
    """
    table = grid.transition_table()
    rows: list[tuple[Any, ...]] = []
    policies: dict[str, Tensor] = {}
    for number in range(config.people.folds):
        fold = split(people, config.people, number, ties=config.method.ties, seed=config.seed)
        for method in ("popl", "pooled_cpl"):
            found = load_set(cells / f"{method}-{number}")
            score = step_scores(found, grid)
            shares = [exact_returns(table, each) for each in score]
            given = dict.fromkeys(fold.held_out, 0)
            if method == "popl":
                alpha = config.method.training.alpha
                given = catered_members(
                    people, fold, found, alpha=alpha, answers=answers, seed=config.seed
                )
            rows += [
                (method, people.names[case], people.groups[case], member, number, *shares[member])
                for case, member in given.items()
            ]
            if number == 0:
                policies |= _typical(method, people, given, score, table)
    columns = ["method", "person", "group", "member", "fold", "greedy", "planned"]
    return Acting(pd.DataFrame(rows, columns=columns), policies)


def _typical(
    method: str, people: People, given: dict[int, int], score: Tensor, table: Table
) -> dict[str, Tensor]:
    """Planned actions of the member that most people of each kind of condition are given."""
    if method != "popl":
        return {"pooled CPL": solve(table, score[0], discount=_DISCOUNT)[0].argmax(1)}
    found = {}
    for kind in ("pr", "regret"):
        members = [m for case, m in given.items() if led_to(people.groups[case]) == kind]
        if members:
            most = int(np.bincount(members).argmax())
            plan = solve(table, score[most], discount=_DISCOUNT)[0]
            found[f"given to {kind} people"] = plan.argmax(1)
    return found


def led_to(group: str) -> str:
    """What a condition has led people to look at: ``pr`` (partial return), ``regret``, or nothing.

    Args:
        group: Name of the condition, such as ``pr-trained`` or ``trained-control``.
    """
    kind = group.partition("-")[0]
    return kind if kind in ("pr", "regret") else ""
