"""Whether policies stay where the data are: what they see, beside what the data saw.

Contrastive preference learning trusts policies far from the data, where nobody was asked: on
continuous observations whole networks that leave the data often fall, or stand still. No group and
no utility is looked at.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.results import Rows
from popl_rl.keys import OBSERVATION
from popl_rl.randomness import stream

__all__ = ["DataRegion", "score_region"]

_INSIDE = 0.95  # share of held-out data that is inside by definition
_REFERENCE, _QUERY = 8000, 2000  # observations that distances are measured to, and from, at most
_LEAST_STD = 1e-2  # a number that hardly ever changes is not blown up
_STARTS = 20  # of fewer different ones a new episode has one of them, as held-out data may
_WIDEST = 1000  # numbers in an observation beyond which distances say nothing: pixels


class DataRegion:
    """The observations that are as near to the data as 95 % of held-out data are.

    Near is the Euclidean distance to the nearest of up to 8000 observations of half of the
    segments, in standard deviations of each number; the other half is held out. Segments with the
    same first observation stay together where there are 20 such observations or more: new episodes
    begin elsewhere, and so must what is held out.

    Args:
        bank: N segments, two or more.
        seed: Seed of the halves and of what is drawn of them.
    """

    def __init__(self, bank: SegmentBank, *, seed: int) -> None:
        self._generator = stream(seed, "region of the data")
        row = bank.row.cpu()
        there = torch.ones_like(row, dtype=torch.bool) if bank.mask is None else bank.mask.cpu()
        first = bank.observation.cpu()[row[:, 0]].flatten(1)
        order = _together(torch.randperm(len(row), generator=self._generator), first)
        near, held = (
            bank.observation.cpu()[self._some(row[half][there[half]], most)].float()
            for half, most in zip(order.tensor_split(2), (_REFERENCE, _QUERY), strict=True)
        )
        self._mean, self._std = near.mean(0), near.std(0).clamp(min=_LEAST_STD)
        self._near = self._scaled(near)
        self.edge = float(self._distance(held).quantile(_INSIDE))

    def share(self, observation: Tensor) -> float:
        """Share of observations ``[B, O]`` that are inside, of 2000 of them at most."""
        some = self._some(observation.cpu().float(), _QUERY)
        return float((self._distance(some) <= self.edge).float().mean())

    def _some(self, rows: Tensor, most: int) -> Tensor:
        """At most so many rows, drawn without replacement."""
        return rows[torch.randperm(len(rows), generator=self._generator)[:most]]

    def _scaled(self, observation: Tensor) -> Tensor:
        return (observation - self._mean) / self._std

    def _distance(self, observation: Tensor) -> Tensor:
        return torch.cdist(self._scaled(observation), self._near).amin(1)


def _together(order: Tensor, first: Tensor) -> Tensor:
    """The order of segments, with those behind each other that begin alike.

    Args:
        order: The N segments in random order.
        first: Their first observations, ``[N, O]``.
    """
    start = first.unique(dim=0, return_inverse=True)[1]
    count = int(start.max()) + 1
    if count < _STARTS:
        return order
    place = order.argsort()
    foremost = torch.full((count,), len(order)).scatter_reduce(0, start, place, "amin")
    return (foremost[start] * len(order) + place).argsort()


def score_region(
    rows: Rows,
    label: str,
    bank: SegmentBank,
    rolled: list[TensorDictBase],
    *,
    seed: int,
) -> None:
    """Add the share of each group's policy's steps that are inside the data, ``inside_data``.

    Nothing is added where observations repeat, are pixels, or there is no second segment.

    Args:
        rows: What is added to.
        label: Name of the method.
        bank: N segments of the data.
        rolled: Episodes ``[1, E, H]`` of the policy that each group was given.
        seed: Seed of the evaluation.
    """
    if bank.is_shared or len(bank) < 2 or bank.observation[0].numel() > _WIDEST:
        return
    region = DataRegion(bank, seed=seed)
    for index, episodes in enumerate(rolled):
        seen = episodes[OBSERVATION][episodes[MASK]]
        rows.add_value((label, "posterior"), index, "inside_data", region.share(seen.flatten(1)))
