"""Median absolute deviation: the tolerance of epsilon-lexicase selection."""

import numpy as np
import torch
from torch import Tensor

__all__ = ["mad", "median_absolute_deviation"]


def mad(values: Tensor) -> Tensor:
    """Median absolute deviation of each case over the population, ``[N, C] -> [C]``.

    The tolerance of epsilon-lexicase selection (La Cava et al., 2016).
    """
    middle = values.median(0).values
    return (values - middle).abs().median(0).values


def median_absolute_deviation(values: Tensor) -> Tensor:
    """Median distance from the median of each column: ``[member, case] -> [case]``."""
    values = values.detach().T.contiguous()
    return _median((values - _median(values)[:, None]).abs_())


def _median(values: Tensor) -> Tensor:
    """Median of each row, the mean of the two middle values if there are two."""
    count, middle = values.shape[1], values.shape[1] // 2
    if values.device.type == "cpu":  # NumPy partitions several times faster than torch
        ordered = torch.from_numpy(np.partition(values.numpy(), middle, axis=1))
        lower = ordered[:, : max(1, middle)].amax(1)
    else:
        ordered = values.sort(dim=1).values
        lower = ordered[:, max(0, middle - 1)]
    upper = ordered[:, middle]
    return upper if count % 2 else (lower + upper) / 2
