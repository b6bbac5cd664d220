"""Which members of a population are needed: as few as predict raters as well as more would."""

from typing import NamedTuple

import torch
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.models.preference_likelihood import per_case

__all__ = ["Nested", "nested_subsets", "sufficient_size"]


class Nested(NamedTuple):
    """Nested subsets of a population, each with one member more than the one before.

    Attributes:
        order: Members in the order in which they enter, the most useful one first.
        value: Mean log-likelihood of each rater's answers under the first k members, ``[K, C]``.
    """

    order: list[int]
    value: Tensor

    def gains(self) -> list[tuple[float, float]]:
        """What each member after the first adds: mean and standard error, paired over raters."""
        gain = self.value.diff(dim=0)
        # A single rater has no spread to judge by.
        error = gain.std(1, correction=0) / gain.shape[1] ** 0.5 if len(gain) else gain.mean(1)
        return list(zip(gain.mean(1).tolist(), error.tolist(), strict=True))


def nested_subsets(
    likelihood: Tensor, comparisons: Comparisons, *, most: int | None = None
) -> Nested:
    """Add members one after the other, each time the one that helps prediction most.

    A set predicts each answer of a rater by the member that the rater's other answers speak for, as
    catering will do for a new person.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``; for an honest
            count of members that were not trained on the rater whose comparison it is.
        comparisons: The M comparisons and the case of each.
        most: Size of the largest subset; all K members if None.

    Returns:
        The subsets, from the one of a single member on.
    """
    own = comparisons.per_answer(likelihood)
    others = per_case(likelihood, comparisons)[:, comparisons.case] - own
    count = comparisons.sizes().clamp(min=1e-6)
    order: list[int] = []
    values = []
    strongest = torch.full_like(others[0], -torch.inf)
    predicted = torch.zeros_like(strongest)
    rest = list(range(len(likelihood)))
    for _ in range(len(rest) if most is None else min(most, len(rest))):
        changed = torch.where(others[rest] > strongest, likelihood[rest], predicted)
        value = per_case(changed, comparisons) / count
        best = int(value.mean(1).argmax())
        predicted = changed[best]
        strongest = torch.maximum(strongest, others[rest[best]])
        order.append(rest.pop(best))
        values.append(value[best])
    return Nested(order, torch.stack(values))


def sufficient_size(nested: Nested, *, evidence: float) -> int:
    """How many members of nested subsets earn their place.

    The largest subset of which every member has improved the prediction by more than ``evidence``
    standard errors, paired over raters.

    Args:
        nested: The subsets.
        evidence: Standard errors; with 0 any improvement counts, with more there are fewer members.
    """
    for size, (gain, error) in enumerate(nested.gains(), start=1):
        if gain <= evidence * error:
            return size
    return len(nested.order)
