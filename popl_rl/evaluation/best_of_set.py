"""What a set would be worth to a group if somebody chose from it who knew, at bounded cost."""

import math
from collections.abc import Iterable, Mapping, Sequence

from torch import Tensor

__all__ = ["best_of_set", "coverage", "lowest", "to_roll"]

_SERVED = 0.9  # recovery from which on a group counts as covered


def to_roll(
    always: Iterable[Tensor], points: Mapping[tuple[str, int], Tensor], *, limit: int
) -> list[int]:
    """Decide which members to roll out, each once: rollouts are what judging costs.

    Args:
        always: Members that must be rolled out, in tensors of any shape.
        points: Members that each point of a curve needs, by kind of catering and number of answers.
            Points are taken in from the most answers on, each with all of its members or not at
            all: leaving single members out would bias its mean.
        limit: Members up to which points are taken in.

    Returns:
        Members, in order.
    """
    chosen = {member for some in always for member in some.flatten().tolist()}
    for _, needed in sorted(points.items(), key=lambda point: -point[0][1]):
        wider = chosen.union(needed.flatten().tolist())
        if len(wider) <= limit:
            chosen = wider
    return sorted(chosen)


def best_of_set(first: Tensor, second: Tensor) -> Tensor:
    """Return of the best of several policies for each group, without the luck of the best.

    The highest of many noisy means lies above what the best policy is worth. So the best on one
    half of the episodes is judged by the other half, and the other way round.

    Args:
        first: Mean returns on the first half of the episodes, ``[P, G]``.
        second: On the other half, ``[P, G]``.

    Returns:
        ``[G]``, the mean of both ways.
    """
    one = second.gather(0, first.argmax(0, keepdim=True))
    other = first.gather(0, second.argmax(0, keepdim=True))
    return (one[0] + other[0]) / 2


def coverage(recoveries: Sequence[float]) -> float:
    """Share of groups with a recovery of at least 0.9; NaN if one is unknown."""
    if any(map(math.isnan, recoveries)):
        return math.nan
    return sum(value >= _SERVED for value in recoveries) / len(recoveries)


def lowest(recoveries: Sequence[float]) -> float:
    """Recovery of the group that is served worst; NaN if one is unknown."""
    return math.nan if any(map(math.isnan, recoveries)) else min(recoveries)
