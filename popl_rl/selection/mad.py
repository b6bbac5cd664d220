"""Median absolute deviation: the tolerance of epsilon-lexicase selection."""

import numpy as np
import torch
from torch import Tensor

__all__ = ["mad"]


def mad(values: Tensor) -> Tensor:
    """Median absolute deviation of each case over the members.

    Median distance from the median (La Cava, Spector and Danai, 2016). With an even number of
    members a median is the mean of the two values in the middle.

    Args:
        values: ``[member, case]``, float32 or float64, finite.

    Returns:
        ``[case]``, without gradients.
    """
    columns = values.detach().T.contiguous()
    return _median((columns - _median(columns)[:, None]).abs_())


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
