"""Learning-rate schedules."""

import torch
from torch.optim.lr_scheduler import LambdaLR

__all__ = ["linear_decay"]


def linear_decay(optimizer: torch.optim.Optimizer, total: int) -> LambdaLR:
    """Hold the learning rate for the first half of ``total`` calls of ``step``, then let it fall.

    It falls linearly to zero, so that what a sampled policy does no longer swings at the end.

    Args:
        optimizer: Whose learning rates are scaled.
        total: Calls of ``step`` to come.
    """
    return LambdaLR(optimizer, lambda done: max(0.0, min(1.0, 2 * (1 - done / total))))
