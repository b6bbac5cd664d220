"""Learning-rate schedules."""

import torch
from torch.optim.lr_scheduler import LambdaLR

__all__ = ["decay", "linear_decay"]


def decay(done: int, total: int) -> float:
    """Factor of the learning rate: 1 for the first half of ``total``, then falling to zero.

    It falls linearly, so that what a sampled policy does no longer swings at the end.
    """
    return max(0.0, min(1.0, 2 * (1 - done / total)))


def linear_decay(optimizer: torch.optim.Optimizer, total: int) -> LambdaLR:
    """Scale the learning rate by `decay` with every call of ``step``.

    Args:
        optimizer: Whose learning rates are scaled.
        total: Calls of ``step`` to come.
    """
    return LambdaLR(optimizer, lambda done: decay(done, total))
