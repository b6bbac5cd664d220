"""Which members of a population are needed: as few as predict raters as well as more would."""

from typing import NamedTuple

import torch
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.models.preference_likelihood import InParts, leave_one_out, per_case

__all__ = [
    "Nested",
    "behind_best",
    "nested_subsets",
    "predicted",
    "sizes_up_to",
    "standard_error",
    "sufficient",
]

_NEGLIGIBLE = 0.0005  # nats of an answer that are not worth a member


def sizes_up_to(most: int) -> list[int]:
    """Numbers of members to be compared: 1, 2, 3, 5, 8, 12, ..., each half as many again."""
    sizes = [1]
    while (further := max(sizes[-1] + 1, -(-3 * sizes[-1] // 2))) <= most:
        sizes.append(further)
    return sizes


class Nested(NamedTuple):
    """Nested subsets of a population, each with one member more than the one before.

    Attributes:
        order: Members in the order in which they enter, the most useful one first.
        value: Mean log-likelihood of each rater's answers under the first k members, ``[K, C]``.
    """

    order: list[int]
    value: Tensor


def nested_subsets(
    likelihood: Tensor | InParts, comparisons: Comparisons, *, most: int | None = None
) -> Nested:
    """Add members one after the other, each time the one that helps prediction most.

    A set predicts each answer of a rater by the member that the rater's other answers speak for, as
    catering will do for a new person.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``, at once or in
            parts, which are worked out again for each member that enters; for an honest count of
            members that were not trained on the rater whose comparison it is.
        comparisons: The M comparisons and the case of each.
        most: Size of the largest subset; all K members if None.

    Returns:
        The subsets, from the one of a single member on.
    """
    blocks = InParts.of(likelihood)
    total = per_case(likelihood, comparisons)
    count = comparisons.sizes().clamp(min=1e-6)
    order: list[int] = []
    values = []
    # Of each comparison: what its case's other answers say for the member that they speak for most,
    # and how likely it is under that member.
    strongest = torch.full((len(comparisons),), -torch.inf, device=total.device)
    predicted = torch.zeros_like(strongest)

    rest = list(range(blocks.members))
    for _ in range(len(rest) if most is None else min(most, len(rest))):
        value = total.new_zeros(len(rest), comparisons.num_cases)
        for part, some in blocks.blocks(comparisons):
            others = total[:, comparisons.case[part]] - comparisons.per_answer(some, part)
            if order:  # the member that has entered last
                speaks, last = others[order[-1]] > strongest[part], some[order[-1]]
                predicted[part] = torch.where(speaks, last, predicted[part])
                strongest[part] = torch.maximum(strongest[part], others[order[-1]])
            changed = torch.where(others[rest] > strongest[part], some[rest], predicted[part])
            value.index_add_(1, comparisons.case[part], comparisons.weighted(changed, part))
        value = value / count
        best = int(value.mean(1).argmax())
        order.append(rest.pop(best))
        values.append(value[best])
    return Nested(order, torch.stack(values))


def predicted(likelihood: Tensor, comparisons: Comparisons) -> Tensor:
    """How well a set predicts each rater, every answer by the member that the others speak for.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``.
        comparisons: The M comparisons and the case of each.

    Returns:
        Mean log-likelihood of each rater's answers, ``[C]``; 0 for a rater without answers.
    """
    count = comparisons.sizes().clamp(min=1e-6)
    return per_case(leave_one_out(likelihood, comparisons), comparisons) / count


def behind_best(value: Tensor) -> Tensor:
    """How far each of several sets is behind the one of the best mean, ``[S, C] -> [S, C]``.

    Args:
        value: How well each set predicts each rater, higher is better.
    """
    return value[value.mean(1).argmax()] - value


def standard_error(behind: Tensor) -> Tensor:
    """Standard error of how far sets are behind, paired over raters, ``[S, C] -> [S]``."""
    error: Tensor = behind.std(1, correction=0) / behind.shape[1] ** 0.5
    return error  # 0 for a single rater, who has no spread to judge by


def sufficient(behind: Tensor, *, evidence: float, negligible: float = _NEGLIGIBLE) -> int:
    """The smallest of several sets that is hardly behind the best.

    Besides, a set may be behind by a little, however sure that is: where raters of one group never
    err, each further member helps a bit.

    Args:
        behind: As of ``behind_best``, the sets by their sizes.
        evidence: Standard errors, paired over raters, by which a set may be behind; with 0 the best
            is taken, with 1 the rule is the one of Breiman et al. (1984).
        negligible: Nats of an answer by which a set may be behind in any case.
    """
    good = behind.mean(1) <= (evidence * standard_error(behind)).clamp(min=negligible)
    return int(good.float().argmax())
