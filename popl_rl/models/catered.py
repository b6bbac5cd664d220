"""A choice from a set of hypotheses for one person."""

from dataclasses import dataclass

from torch import Tensor

__all__ = ["Catered"]


@dataclass(frozen=True)
class Catered:
    """A choice from a set for one rater.

    Attributes:
        member: The chosen hypothesis.
        weights: Belief in each hypothesis, ``[N]``, summing to 1.
    """

    member: int
    weights: Tensor
