"""What the majority of the raters prefers, and where that goes round in circles.

Every rater may have an order of preference and the majority none (Condorcet's paradox, 1785). Then
no single utility, and no policy that maximises one, can say what the majority prefers.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["find_cycle", "majority_preference"]

_EQUAL = 1e-6  # worths that are equal up to rounding, as for held-out pairs


def majority_preference(
    segment_utility: Tensor, *, shares: Sequence[float] | Tensor | None = None
) -> Tensor:
    """How many of the raters prefer one thing to another.

    Args:
        segment_utility: What each of N things is worth to each group, ``[G, N]``.
        shares: Share of each group among the raters, summing to 1; equal if None.

    Returns:
        Share of the raters who prefer thing i to thing j, float64 ``[N, N]``. Who finds both
        worth the same (within 1e-6) counts half, so that entries ij and ji sum to 1.

    Raises:
        ValueError: If ``segment_utility`` is no table of finite numbers or ``shares`` are no
            shares of its groups.
    """
    if (
        segment_utility.ndim != 2
        or not len(segment_utility)
        or not bool(segment_utility.isfinite().all())
    ):
        raise ValueError(
            "segment_utility must be finite, of shape [groups, things] with at least one group, "
            f"got shape {list(segment_utility.shape)} with "
            f"{int((~segment_utility.isfinite()).sum())} NaN or infinite"
        )
    count = len(segment_utility)
    given = torch.full((count,), 1 / count) if shares is None else torch.as_tensor(shares)
    given = given.to(segment_utility.device, torch.float64)
    proper = given.shape == (count,) and bool((given >= 0).all())
    if not proper or not abs(float(given.sum()) - 1) <= 1e-6:
        raise ValueError(
            f"shares must be {count} non-negative numbers, one per group, that sum to 1, got "
            f"{given.tolist()}"
        )
    preferred = torch.zeros(
        2 * segment_utility.shape[1:], dtype=torch.float64, device=segment_utility.device
    )
    for values, share in zip(segment_utility.double(), given / given.sum(), strict=True):
        difference = values.unsqueeze(1) - values
        preferred += share * torch.where(difference.abs() <= _EQUAL, 0.5, (difference > 0).double())
    return preferred


def find_cycle(preferred: Tensor, *, threshold: float = 0.5) -> list[int] | None:
    """Find three things that a majority prefers in a circle.

    Where one of any two things beats the other there are circles only if there is one of three
    things; among things of which none beats the other there may be longer ones, which are not
    found.

    Args:
        preferred: Share of the raters who prefer thing i to thing j, ``[N, N]``, from
            ``majority_preference``. Memory and time grow with N³; up to 200 things are a matter of
            a second.
        threshold: Share that must be exceeded to beat another thing, at least 0.5.

    Returns:
        Things a, b and c of which a beats b, b beats c and c beats a; a is the first of them. Of
        several circles, one of those whose narrowest majority is widest: the one nearest to their
        average. None if there is none.

    Raises:
        ValueError: If ``preferred`` is not square or not finite, or the threshold is below 0.5.
    """
    if preferred.ndim != 2 or preferred.shape[0] != preferred.shape[1]:
        raise ValueError(f"preferred must have shape [N, N], got {list(preferred.shape)}")
    if not bool(preferred.isfinite().all()):
        raise ValueError("preferred must be finite, got NaN or infinite shares")
    if not threshold >= 0.5:
        raise ValueError(f"threshold must be at least 0.5, a majority, got {threshold}")
    # Rounding must not turn a draw into a majority.
    wins = torch.where(preferred > threshold + 1e-9, preferred, 0.0).float()
    narrowest = torch.minimum(wins.unsqueeze(2), wins)  # a beats b, b beats c
    narrowest = torch.minimum(narrowest, wins.T.unsqueeze(1))  # c beats a
    widest = narrowest.amax() if narrowest.numel() else 0
    if not widest > 0:
        return None
    circles = (narrowest >= widest - _EQUAL).nonzero()
    # Each circle is listed from each of its three things.
    circles = circles[circles[:, 0] == circles.amin(1)]
    aside = (circles - circles.double().mean(0)).square().sum(1)
    found: list[int] = circles[aside.argmin()].tolist()
    return found
