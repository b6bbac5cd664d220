"""Segments as a learner reads them: observations and actions, each distinct observation once."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import ACTION, OBSERVATION

__all__ = ["SegmentBank"]


@dataclass(frozen=True)
class SegmentBank:
    """Segments as the learner reads them: observations and actions only.

    Attributes:
        observation: Distinct observations ``[U, O]`` (all of them, ``U = N T``, if few repeat).
        row: Row of ``observation`` seen at each step, ``[N, T]``.
        action: ``[N, T]`` int64 or ``[N, T, A]`` float32.
        is_shared: Whether observations repeat, so that ``U`` is small against ``N T``.
    """

    observation: Tensor
    row: Tensor
    action: Tensor
    is_shared: bool

    def __len__(self) -> int:
        return self.row.shape[0]

    @classmethod
    def from_segments(cls, segments: TensorDictBase) -> "SegmentBank":
        """Index segments ``[N]`` or ``[N, T]`` by their distinct observations."""
        observation, action = segments[OBSERVATION], segments[ACTION]
        flat = observation.flatten(0, 1)
        distinct, inverse = flat.unique(dim=0, return_inverse=True)
        if len(distinct) <= len(flat) // 4:
            return cls(distinct, inverse.view(observation.shape[:2]), action, True)
        row = torch.arange(len(flat), device=flat.device).view(observation.shape[:2])
        return cls(flat, row, action, False)

    def subset(self, index: Tensor) -> "SegmentBank":
        """Some of the segments, in the order of ``index``."""
        row, action = self.row[index], self.action[index]
        if self.is_shared:
            return SegmentBank(self.observation, row, action, True)
        own = torch.arange(row.numel(), device=row.device).view(row.shape)
        return SegmentBank(self.observation[row.flatten()], own, action, False)

    def to(self, device: torch.device | str) -> "SegmentBank":
        """The same segments on another device."""
        return SegmentBank(
            self.observation.to(device), self.row.to(device), self.action.to(device), self.is_shared
        )
