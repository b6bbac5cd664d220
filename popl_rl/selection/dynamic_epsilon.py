"""Dynamic epsilon-lexicase selection: the tolerance is the deviation within the pool.

In the terms of La Cava et al. (2019, doi 10.1162/evco_a_00224). Nothing here checks its arguments.
"""

import torch
from torch import Tensor

from popl_rl.selection.mad import mad

__all__ = ["select_dynamically"]


def select_dynamically(
    scores: Tensor, labels: Tensor, num_selected: int, *, limit: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Select members with a tolerance that is worked out anew in each pool, one after the other.

    Neither merging nor drawing cases twice is exact here: how many share a score, and how often a
    case is met, both matter.

    Args:
        scores: ``[member, case]``, floating.
        labels: Number of each member's behaviour, ``[member]``.
        num_selected: Parents to select.
        limit: Cases that each selection may look at.
        generator: Source of the case orders and of the tie breaks.

    Returns:
        The member chosen by each selection and its depth, ``[num_selected]`` each.
    """
    device = scores.device
    parents = torch.empty(num_selected, dtype=torch.long, device=device)
    depths = torch.zeros_like(parents)
    everyone = torch.arange(len(scores), device=device)
    several = bool((labels != labels[0]).any())
    for selection in range(num_selected):
        pool = everyone
        if several:
            order = torch.randperm(scores.shape[1], generator=generator, device=device)[:limit]
            for depth, case in enumerate(order.tolist(), start=1):
                values = scores[pool, case]
                tolerance = mad(values[:, None])
                stay = values >= values.amax() - tolerance
                if bool(stay.all()):
                    continue
                pool = pool[stay]
                depths[selection] = depth
                if bool((labels[pool] == labels[pool[0]]).all()):
                    break
        draw = torch.randint(len(pool), (), generator=generator, device=device)
        parents[selection] = pool[draw]
    return parents, depths
