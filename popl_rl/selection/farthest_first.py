"""Farthest-first traversal: points far from each other, one after the other."""

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["Similarity", "farthest_first"]

#: Maps indices of points ``[A]``, or the slice of all of them, and ``[B]`` to how alike they are,
#: ``[A, B]``: the greater, the nearer.
Similarity = Callable[[Tensor | slice, Tensor], Tensor]

# Candidates examined together: enough to fill a matrix product, few enough to fit into memory.
_BATCH = 64


def farthest_first(
    similarity: Similarity,
    num_points: int,
    count: int,
    *,
    first: int | None = None,
    repeat: bool = False,
    generator: torch.Generator | None = None,
    device: torch.device | None = None,
) -> Tensor:
    """Keep, again and again, the point that is least like the one most like it of those kept.

    Args:
        similarity: How alike points are; asked for a few columns at a time, never for all pairs.
        num_points: Number of points.
        count: Points to keep, at most ``num_points`` unless ``repeat``.
        first: The point to begin with. None: all are equally far, as in any other tie.
        repeat: Whether points already kept stay candidates, so that they come back once nothing
            is farther away than they are.
        generator: Breaks ties at random. None: the point with the least index wins.
        device: Where the similarities are.

    Returns:
        Indices in the order in which they were kept, ``[count]``, int64.
    """
    nearest = torch.full((num_points,), -torch.inf, device=device)  # likeness to the nearest kept
    kept = torch.empty(0, dtype=torch.long, device=device)
    new = None if first is None else torch.tensor([first], device=device)
    while True:
        if new is None:
            new = _farthest(similarity, nearest, generator)
        kept = torch.cat([kept, new])
        if len(kept) >= count:
            return kept[:count]
        nearest = torch.maximum(nearest, similarity(slice(None), new).amax(1))
        if not repeat:
            nearest[kept] = torch.inf
        new = None


def _farthest(similarity: Similarity, nearest: Tensor, generator: torch.Generator | None) -> Tensor:
    """Points that would be kept next, one after the other."""
    if generator is None:
        return nearest.argmin().unsqueeze(0)
    # The farthest points are visited in random order. One that is no longer as far, because of
    # another taken just before it, is passed over: as if each were drawn after the other.
    level = nearest.min()
    farthest = (nearest == level).nonzero().view(-1)
    order = torch.randperm(len(farthest), generator=generator, device=nearest.device)
    visited = farthest[order[:_BATCH]]
    apart = (similarity(visited, visited) <= level).tolist()
    taken: list[int] = []
    for candidate in range(len(visited)):
        if all(apart[candidate][other] for other in taken):
            taken.append(candidate)
    return visited[taken]
