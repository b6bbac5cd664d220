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


def nested_subsets(likelihood: Tensor, comparisons: Comparisons) -> Nested:
    """Add members one after the other, each time the one that helps prediction most.

    A set predicts each answer of a rater by the member that the rater's other answers speak for, as
    catering will do for a new person.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``; for an honest
            count of members that were not trained on the rater whose comparison it is.
        comparisons: The M comparisons and the case of each.

    Returns:
        The subsets, up to all K members.
    """
    own = comparisons.per_answer(likelihood)
    others = per_case(likelihood, comparisons)[:, comparisons.case] - own
    count = comparisons.sizes().clamp(min=1e-6)
    order: list[int] = []
    values = []
    strongest = torch.full_like(others[0], -torch.inf)
    predicted = torch.zeros_like(strongest)
    rest = list(range(len(likelihood)))
    while rest:
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
    for size, gain in enumerate(nested.value.diff(dim=0), start=1):
        error = gain.std(correction=0) / len(gain) ** 0.5
        if gain.mean() <= evidence * error:
            return size
    return len(nested.value)
