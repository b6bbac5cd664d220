"""Trials: numbers of niches are compared by members as good as those that come out in the end.

In a search, members have shared raters with others for most of the time, so that two neighbouring
niches may be predicted better together, though they are two, and two halves of one niche better
apart. So numbers that look well are tried out: for each search, fresh members are trained on the
division that all searches agree upon, without the raters that the search has not learnt of, and
predict these.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from popl_rl.algorithms.agreement import Agreement
from popl_rl.algorithms.divisions import prediction
from popl_rl.algorithms.niche_members import train_niches
from popl_rl.algorithms.problem import Problem
from popl_rl.models.calibration import scale_for_strangers

__all__ = ["Fold", "Trial", "trials"]


class Fold(NamedTuple):
    """Raters of whom members learn, and raters by whom they are judged.

    Attributes:
        learnt: The problem without the answers of those by whom it is judged.
        judged: The problem with their answers only.
    """

    learnt: Problem
    judged: Problem


class Trial(NamedTuple):
    """How fresh members of a number of niches do with people of whom they have not learnt.

    Attributes:
        value: Mean log-likelihood of the answers of each rater, each as predicted by members that
            have not learnt of them, ``[C]``.
        scale: How much scores are to be believed by such people, see
            ``popl_rl.models.calibration.scale_for_strangers``.
    """

    value: Tensor
    scale: float


def trials(
    problem: Problem,
    folds: Sequence[Fold],
    agreed: Sequence[Agreement],
    *,
    generations: int,
    generator: torch.Generator,
) -> dict[int, Trial]:
    """Try the number of niches that looks best, and go on to its neighbours while these do better.

    Args:
        problem: What is to be learnt, all raters of it.
        folds: What each search has learnt of and what not.
        agreed: What searches agree upon, by growing numbers of niches.
        generations: Generations of training, ``problem.block`` steps each.
        generator: Source of initial weights and batches.

    Returns:
        The trials by their index in ``agreed``; the best one's neighbours are among them.
    """
    found: dict[int, Trial] = {}
    best = max(range(len(agreed)), key=lambda index: _mean(agreed[index].value))
    while True:
        around = range(max(0, best - 1), min(best + 2, len(agreed)))
        untried = [index for index in around if index not in found]
        if not untried:
            return found
        for index in untried:
            served = agreed[index].served(problem)
            found[index] = _trial(folds, served, generations=generations, generator=generator)
        best = max(found, key=lambda index: _mean(found[index].value))


def _trial(
    folds: Sequence[Fold], served: Tensor, *, generations: int, generator: torch.Generator
) -> Trial:
    """Fresh members for one division of the raters ``served``, ``[K, C]``, in each fold."""
    margins = []
    for learnt, judged in folds:
        members = train_niches(learnt, served, generations=generations, generator=generator)
        margins.append(judged.margins(members.stack))
    answers = [judged.comparisons for _, judged in folds]
    values = [prediction(margin, own) for margin, own in zip(margins, answers, strict=True)]
    return Trial(torch.stack(values).sum(0), scale_for_strangers(margins, answers))


def _mean(value: Tensor) -> float:
    return float(value.mean())
