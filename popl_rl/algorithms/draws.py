"""Batches of comparisons: how often each member draws each."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from popl_rl.data.comparisons import Comparisons

__all__ = ["Draws", "by_case", "by_comparison", "uniform"]

# Up to so many comparisons ``torch.multinomial`` draws. It adds up all weights of all members at
# every step, in float32, in which small weights are lost among millions, and takes 2^24 at most.
_FEW = 2**17

# A member that is strong nowhere, or serves nobody, still needs something: everything, a bit.
_LEAST = 1e-6


@dataclass(frozen=True)
class Draws:
    """How often each member draws each comparison.

    Attributes:
        draw: Maps a batch size B and a generator to comparisons drawn with replacement, ``[N, B]``.
        answers: Answers that each member learns from, ``[N]``: the sum of its weights, in which a
            comparison that is fully its own counts 1.
    """

    draw: Callable[[int, torch.Generator], Tensor]
    answers: Tensor

    def __call__(self, batch_size: int, generator: torch.Generator) -> Tensor:
        """Comparisons of a batch for each member, ``[N, B]``."""
        return self.draw(batch_size, generator)


def uniform(comparisons: Comparisons, count: int) -> Draws:
    """All comparisons alike, but for weights of their own.

    Args:
        comparisons: M comparisons.
        count: Members N.
    """
    if comparisons.weight is not None:
        return by_case(
            comparisons, comparisons.weight.new_ones(count, comparisons.num_cases), least=0.0
        )
    number, device = len(comparisons), comparisons.preferred.device

    def draw(batch_size: int, generator: torch.Generator) -> Tensor:
        return torch.randint(number, (count, batch_size), generator=generator, device=device)

    return Draws(draw, torch.full((count,), float(number), device=device))


def by_comparison(comparisons: Comparisons, weight: Tensor, *, least: float = _LEAST) -> Draws:
    """By weights of members for comparisons, and the comparisons' own besides.

    Args:
        comparisons: M comparisons.
        weight: ``[N, M]``, not negative.
        least: What is added to every weight; if 0, each row needs a positive one.
    """
    weight = comparisons.weighted(weight + least)
    if len(comparisons) <= _FEW:
        return Draws(
            lambda batch_size, generator: torch.multinomial(
                weight, batch_size, replacement=True, generator=generator
            ),
            weight.sum(1),
        )
    total = weight.cumsum(1, dtype=torch.float64)
    return Draws(lambda batch_size, generator: _draw(total, batch_size, generator), total[:, -1])


def by_case(comparisons: Comparisons, weight: Tensor, *, least: float = _LEAST) -> Draws:
    """By weights of members for the cases of comparisons, and the comparisons' own besides.

    Where there are many comparisons a case is drawn first, then one of its comparisons, so that
    neither time nor memory is taken for each member and comparison.

    Args:
        comparisons: M comparisons of C cases.
        weight: ``[N, C]``, not negative.
        least: What is added to every weight; if 0, each row needs a positive one, of a case that
            has comparisons.
    """
    if len(comparisons) <= _FEW:
        return by_comparison(comparisons, weight[:, comparisons.case], least=least)
    grouped = comparisons.grouped
    size = grouped.stop.diff(prepend=grouped.stop.new_zeros(1))
    total = ((weight + least) * size).cumsum(1)

    def draw(batch_size: int, generator: torch.Generator) -> Tensor:
        case = _draw(total, batch_size, generator)
        shape, device = case.shape, case.device
        left = 1 - torch.rand(shape, generator=generator, dtype=torch.float64, device=device)
        place = torch.searchsorted(
            grouped.total, grouped.stop[case] - left * size[case], right=True
        )
        # Rounding must not lead to the next case.
        return grouped.order[place.minimum(grouped.last[case])]

    return Draws(draw, total[:, -1])


def _draw(total: Tensor, batch_size: int, generator: torch.Generator) -> Tensor:
    """Entries by weights of which these are the sums up to each, ``[N, W] -> [N, B]``."""
    shape = (len(total), batch_size)
    chance = torch.rand(shape, generator=generator, dtype=torch.float64, device=total.device)
    # Entries of weight 0 share their sum with the one before, and are passed over.
    found = torch.searchsorted(total, chance * total[:, -1:], right=True)
    return found.clamp(max=total.shape[1] - 1)
