"""Pairs of segments that may be compared, drawn at random."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import START

__all__ = ["draw_pairs", "starts_of"]


def starts_of(segments: TensorDictBase) -> Tensor | None:
    """Which segments may be compared with each other, ``[N]``; None if all of them.

    Args:
        segments: TensorDict ``[N, T]``.
    """
    start = segments.get(START, None)
    return None if start is None else start[:, 0].long()


def draw_pairs(
    num_segments: int,
    num_pairs: int,
    *,
    start: Tensor | None = None,
    generator: torch.Generator,
) -> Tensor:
    """Uniform pairs of two different segments, ``[num_pairs, 2]``.

    Args:
        num_segments: Number of segments N.
        num_pairs: Pairs to draw.
        start: Segments with the same number may be compared, ``[N]``; all if None.
        generator: Source of the pairs.

    Raises:
        ValueError: If some segment shares its start with no other.
    """
    if start is None:
        first = torch.randint(num_segments, (num_pairs,), generator=generator)
        # A shift of 1..N-1 never lands on the first segment again.
        shift = torch.randint(1, num_segments, (num_pairs,), generator=generator)
        return torch.stack([first, (first + shift) % num_segments], -1)
    # Segments in the order of their starts, each start a run of some length.
    order = start.argsort(stable=True)
    lengths = start[order].unique_consecutive(return_counts=True)[1]
    if int(lengths.min()) < 2:
        raise ValueError(
            f"every start must be shared by two segments or more, to compare them, but "
            f"{int((lengths < 2).sum())} of {len(lengths)} starts have a single one; collect more "
            "segments from each start"
        )
    begins = lengths.cumsum(0) - lengths
    begin, length = (each.repeat_interleave(lengths) for each in (begins, lengths))
    place = torch.randint(num_segments, (num_pairs,), generator=generator)
    chance = torch.rand(num_pairs, generator=generator, dtype=torch.double)
    ahead = 1 + (chance * (length[place] - 1)).long()
    other = begin[place] + (place - begin[place] + ahead) % length[place]
    return torch.stack([order[place], order[other]], -1)
