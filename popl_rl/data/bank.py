"""Segments as a learner reads them: observations and actions, each distinct observation once."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import ACTION, MASK, OBSERVATION

__all__ = ["SegmentBank"]


@dataclass(frozen=True)
class SegmentBank:
    """Segments as the learner reads them: observations and actions only.

    Attributes:
        observation: Distinct observations ``[U, O]`` (all of them, ``U = N T``, if few repeat).
        row: Row of ``observation`` seen at each step, ``[N, T]``.
        action: ``[N, T]`` int64 or ``[N, T, A]`` float32.
        is_shared: Whether observations repeat, so that ``U`` is small against ``N T``.
        mask: Steps that there are, ``[N, T]`` bool, where segments differ in length; None where
            all have T. Other steps are filled with whatever is valid, and count for nothing.
    """

    observation: Tensor
    row: Tensor
    action: Tensor
    is_shared: bool
    mask: Tensor | None = None

    def __len__(self) -> int:
        return self.row.shape[0]

    @classmethod
    def from_segments(cls, segments: TensorDictBase) -> "SegmentBank":
        """Index segments ``[N]`` or ``[N, T]`` by their distinct observations."""
        observation, action = segments[OBSERVATION], segments[ACTION]
        mask = segments.get(MASK, None)
        flat = observation.flatten(0, 1)
        most = len(flat) // 4
        if _at_least(flat) <= most:
            distinct, inverse = flat.unique(dim=0, return_inverse=True)
            if len(distinct) <= most:
                return cls(distinct, inverse.view(observation.shape[:2]), action, True, mask)
        row = torch.arange(len(flat), device=flat.device).view(observation.shape[:2])
        return cls(flat, row, action, False, mask)

    def subset(self, index: Tensor) -> "SegmentBank":
        """Some of the segments, in the order of ``index``."""
        row, action = self.row[index], self.action[index]
        mask = None if self.mask is None else self.mask[index]
        if self.is_shared:
            return SegmentBank(self.observation, row, action, True, mask)
        own = torch.arange(row.numel(), device=row.device).view(row.shape)
        return SegmentBank(self.observation[row.flatten()], own, action, False, mask)

    def to(self, device: torch.device | str) -> "SegmentBank":
        """The same segments on another device."""
        mask = None if self.mask is None else self.mask.to(device)
        observation, row = self.observation.to(device), self.row.to(device)
        return SegmentBank(observation, row, self.action.to(device), self.is_shared, mask)

    def weights(self, segment: Tensor | slice, *, discount: float = 1.0) -> Tensor:
        """What each step counts for in a segment's score: its discount, 0 where there is none.

        Args:
            segment: Segment numbers of any shape ``[...]``, or a slice of them.
            discount: Per-step discount gamma.

        Returns:
            ``[..., T]``, or ``[T]`` where all segments have T steps.
        """
        steps = torch.arange(self.row.shape[1], device=self.row.device).float()
        weight: Tensor = discount**steps
        return weight if self.mask is None else self.mask[segment] * weight


def _at_least(rows: Tensor) -> int:
    """A number of different rows ``[R, O]`` that there are at least, without comparing them.

    Rows that never repeat, as in continuous worlds, are told in a fraction of the time that sorting
    takes.
    """
    if rows.dtype != torch.float32:
        return 0
    # Sums of whole numbers are exact; those of floats may depend on where a row stands. Adding 0
    # makes -0 and 0, which are equal, alike in bits.
    bits = (rows + 0.0).contiguous().view(torch.int32).long()
    generator = torch.Generator().manual_seed(0)
    factor = torch.randint(2**62, (bits.shape[1],), generator=generator) | 1  # odd: no bit is lost
    return len((bits * factor.to(bits.device)).sum(1).unique())
