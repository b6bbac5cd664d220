"""Is everybody alike? Before one niche is taken for all, raters predicted worse are set apart.

Where two groups answer nearly everything alike, members pull each other back to what all say, and
searches end with one niche though there are two. What is left of the smaller group is that its
raters are predicted worse. So they are set apart, two fresh members take one part each and then
divide the raters anew, and raters of whom they have not learnt tell whether the division is there.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from popl_rl.algorithms.agreement import Agreement
from popl_rl.algorithms.divisions import Division, prediction
from popl_rl.algorithms.niche_members import GIVEN, train_niches
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.trials import Fold

__all__ = ["divided_in_two"]


def divided_in_two(
    problem: Problem,
    folds: Sequence[Fold],
    value: Tensor,
    *,
    generations: int,
    generator: torch.Generator,
) -> Agreement | None:
    """Two niches, begun by who is predicted better and worse than the mean by one for all.

    Args:
        problem: What is to be learnt, all raters of it.
        folds: Who is learnt of and who judges, side by side.
        value: Mean log-likelihood of the answers of each rater, as predicted by one niche that has
            not learnt of them, ``[C]``.
        generations: Generations of training, ``problem.block`` steps each.
        generator: Source of initial weights and batches.

    Returns:
        The two niches, and how they predict raters of whom they have not learnt; None if all raters
        are predicted alike.
    """
    asked = problem.comparisons.sizes() > 0
    worse = value < value[asked].mean()
    if not bool(worse[asked].any()):
        return None
    served = torch.stack([~worse, worse]).to(value)
    parts = [_in_two(fold, served, generations, generator) for fold in folds]
    # Niches are numbered alike in all parts, which began alike.
    return Agreement(parts, torch.stack([part.value for part in parts]).sum(0), found=2)


def _in_two(fold: Fold, served: Tensor, generations: int, generator: torch.Generator) -> Division:
    """Two members of one fold, and how they predict its other raters."""
    both = train_niches(
        fold.learnt, served, generations=generations, given=GIVEN, generator=generator
    )
    niche = torch.arange(2, device=served.device)
    value = prediction(fold.judged.margins(both.stack), fold.judged.comparisons)
    return Division(both.stack, both.share, niche, value)
