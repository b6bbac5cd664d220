"""Median absolute deviation: the tolerance of epsilon-lexicase selection."""

from torch import Tensor

__all__ = ["mad"]


def mad(values: Tensor) -> Tensor:
    """Median absolute deviation of each case over the population, ``[N, C] -> [C]``.

    The tolerance of epsilon-lexicase selection (La Cava et al., 2016).
    """
    middle = values.median(0).values
    return (values - middle).abs().median(0).values
