"""Which utilities rank things alike: members of a population, and what groups of raters want."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

__all__ = ["alike", "order_by_agreement", "rank_shares"]

_EQUAL = 1e-6  # true utilities that are equal up to rounding, as for held-out pairs
Array = NDArray[np.float64]


def rank_shares(members: ArrayLike, truth: ArrayLike) -> Array:
    """Who ranks which pairs of states as a group does.

    Args:
        members: Utilities of K hypotheses, ``[K, S]``.
        truth: The group's true utility, ``[S]``.

    Returns:
        Share of the hypotheses that strictly prefer whichever of states i and j the group prefers,
        ``[S, S]``; a tie is no agreement. NaN where the group does not care.

    Raises:
        ValueError: If shapes do not fit together or numbers are not finite.
    """
    wanted = np.asarray(truth, dtype=np.float64)
    table = checked_table("members", members, wanted)
    apart = wanted[:, None] - wanted
    right = np.zeros(apart.shape)
    for member in table:
        right += np.sign(member[:, None] - member) == np.sign(apart)
    shares: Array = np.where(np.abs(apart) > _EQUAL, right / len(table), np.nan)
    return shares


def alike(members: ArrayLike, truths: Mapping[str, ArrayLike]) -> Array:
    """How alike any two utilities rank the states.

    Args:
        members: Utilities of K hypotheses, ``[K, S]``.
        truths: Group name -> true utility, ``[S]``.

    Returns:
        ``[G + K, G + K]``, the groups' true utilities first: share of the pairs of states that both
        rank, strictly and in the same way. Pairs that a group does not care about do not count for
        this group; a hypothesis's ties count as disagreement, with itself too, so that a constant
        utility has 0 everywhere. NaN where there is no such pair.

    Raises:
        ValueError: If shapes do not fit together or numbers are not finite.
    """
    table = checked_table("members", members, None)
    wanted = checked_table("truths", [*truths.values()], table[0])
    first, second = np.triu_indices(table.shape[1], 1)
    apart = wanted[:, first] - wanted[:, second]
    cares = np.abs(apart) > _EQUAL
    signs = np.concatenate(
        [np.sign(apart) * cares, np.sign(table[:, first] - table[:, second])]
    ).astype(np.float32)
    asked = np.concatenate([cares, np.ones((len(table), len(first)), bool)]).astype(np.float32)
    up, down = (signs > 0).astype(np.float32), (signs < 0).astype(np.float32)
    counted = asked @ asked.T
    same = (up @ up.T + down @ down.T).astype(np.float64)
    shares: Array = np.full_like(same, np.nan)
    np.divide(same, counted, out=shares, where=counted > 0)
    return shares


def order_by_agreement(likeness: ArrayLike) -> NDArray[np.int64]:
    """Order hypotheses so that those that are alike are neighbours.

    Args:
        likeness: ``[K, K]``, symmetric, from 0 (unlike) to 1 (alike).

    Returns:
        ``[K]``, the leaves of an average-linkage clustering from left to right.
    """
    table = np.asarray(likeness, dtype=np.float64)
    if len(table) < 3:
        return np.arange(len(table))
    far = 1 - (table + table.T) / 2
    np.fill_diagonal(far, 0)
    tree = linkage(squareform(far, checks=False), "average", optimal_ordering=True)
    return leaves_list(tree).astype(np.int64)


def checked_table(what: str, curves: Any, at: Array | None) -> Array:
    """Return curves ``[K, S]``, checked; ``at`` has a number for each of the S states."""
    values: Array = np.asarray(curves, dtype=np.float64)
    states = values.shape[-1] if at is None else len(at)
    if values.ndim != 2 or not len(values) or values.shape[1] != states:
        raise ValueError(f"{what} must have shape [curves, {states} states], got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{what} must be finite, got NaN or infinite numbers")
    return values
