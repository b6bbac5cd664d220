"""Preferences in the form a learner reads: no group, no utility, no rater model."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import ANSWER, CHANCE, PAIR, RATER, Answer

__all__ = ["Comparisons", "Grouped"]


class Grouped(NamedTuple):
    """Comparisons in the order of their cases.

    Attributes:
        order: The comparisons, ``[M]``.
        total: Sums of their weights in this order, each up to and with its own, ``[M]`` float64.
        last: Place in this order of each case's last comparison, ``[C]``; of a case without any
            that of the case before.
        stop: Sums of the weights up to the end of each case, ``[C]`` float64.
    """

    order: Tensor
    total: Tensor
    last: Tensor
    stop: Tensor


@dataclass(frozen=True)
class Comparisons:
    """Strict preferences as a learner reads them; hidden keys are never looked at.

    A tie that counts, and an answer with a soft label, are two comparisons, one each way, whose
    weights sum to 1: the cross-entropy of a label in [0, 1] (Christiano et al., 2017, section
    2.2.3). They are comparisons of the same case.

    Attributes:
        preferred: Segment that was preferred, ``[M]``.
        other: Segment it was preferred to, ``[M]``.
        case: What lexicase filters on: the rater's number, or the preference's own, ``[M]``.
        num_cases: Number of cases C.
        num_dropped: Ties and skips that were left out.
        weight: How much each comparison counts, ``[M]`` in (0, 1]; None if all count 1.
        answer: Number of the answer that each comparison is of, ``[M]``, the same for the two
            comparisons of one answer; None if every comparison is an answer.
    """

    preferred: Tensor
    other: Tensor
    case: Tensor
    num_cases: int
    num_dropped: int = 0
    weight: Tensor | None = None
    answer: Tensor | None = None

    def __len__(self) -> int:
        return len(self.preferred)

    @property
    def is_single(self) -> bool:
        """Whether every case is a single preference, as where nobody kept rater ids."""
        return self.num_cases == len(self)

    def weighted(self, value: Tensor) -> Tensor:
        """Values of comparisons ``[..., M]`` times how much each counts."""
        return value if self.weight is None else value * self.weight

    def sizes(self) -> Tensor:
        """Comparisons of each case, by their weights, ``[C]``."""
        return self.case.bincount(self.weight, minlength=self.num_cases)

    @cached_property
    def grouped(self) -> Grouped:
        """The comparisons in the order of their cases; worked out once."""
        order = self.case.argsort(stable=True)
        weight = torch.ones_like(self.case) if self.weight is None else self.weight[order]
        total = weight.cumsum(0, dtype=torch.float64)
        last = self.case.bincount(minlength=self.num_cases).cumsum(0) - 1
        stop = torch.where(last < 0, 0.0, total[last.clamp(min=0)])
        return Grouped(order, total, last, stop)

    def blocks(self, size: int) -> Iterator[slice]:
        """Slices of at most ``size`` comparisons, all of them one after the other."""
        for start in range(0, len(self), size):
            yield slice(start, min(start + size, len(self)))

    @classmethod
    def from_preferences(
        cls,
        preferences: TensorDictBase,
        *,
        cases: str,
        ties: Literal["drop", "count"] = "drop",
    ) -> "Comparisons":
        """Keep the strict answers; or also ties and soft labels, as what they say.

        Args:
            preferences: TensorDict ``[M]`` with ``pair``, ``answer`` and, for rater cases,
                ``rater``. A rater of -1 is unknown: each such answer is a case of its own.
            cases: ``"preference"`` or ``"rater"``.
            ties: ``"drop"``: ties are left out, soft labels count as the answer that they are
                nearer to. ``"count"``: both count by halves, or by their ``chance``; with a case
                for each rater only, since halves of one answer are no cases.

        Returns:
            The M' strict ones, each with its case; raters' cases are numbered from 0.

        Raises:
            ValueError: If ``cases`` or ``ties`` is none of these, rater ids are needed and
                missing, answers are no ``popl_rl.keys.Answer``, or no answer is strict.
        """
        if cases not in ("preference", "rater"):
            raise ValueError(f"cases must be 'preference' or 'rater', got {cases!r}")
        if ties not in ("drop", "count"):
            raise ValueError(f"ties must be 'drop' or 'count', got {ties!r}")
        if cases == "rater" and RATER not in preferences.keys():  # noqa: SIM118 - not a dict
            raise ValueError(
                "preferences must hold 'rater', the id of who answered, for cases='rater'; without "
                "ids use cases='preference'"
            )
        answer = preferences[ANSWER]
        _check_answers(answer)
        counting = ties == "count" and cases == "rater"
        kept = answer <= (Answer.TIE if counting else Answer.SECOND)
        if not (answer <= Answer.SECOND).any():
            raise ValueError(
                f"preferences must hold a strict answer, got {len(answer)} ties and skips; lower "
                "the raters' tie and skip thresholds or ask about more different segments"
            )
        pair, said = preferences[PAIR][kept], answer[kept]
        soft = preferences.get(CHANCE, None)
        chance = torch.where(said == Answer.TIE, 0.5, said.float())
        if counting and soft is not None:
            chance = soft[kept]
        side = (chance >= 0.5).long().unsqueeze(-1)
        preferred = pair.gather(-1, side).squeeze(-1)
        other = pair.gather(-1, 1 - side).squeeze(-1)
        if cases == "preference":
            case = torch.arange(len(preferred), device=pair.device)
        else:
            case = _named(preferences[RATER][kept]).unique(return_inverse=True)[1]
        count, dropped = int(case.max()) + 1, int((~kept).sum())
        doubt = torch.minimum(chance, 1 - chance)
        unsure = (doubt > 0).nonzero().squeeze(-1)
        if not len(unsure):
            return cls(preferred, other, case, count, dropped)
        return cls(
            torch.cat([preferred, other[unsure]]),
            torch.cat([other, preferred[unsure]]),
            torch.cat([case, case[unsure]]),
            count,
            dropped,
            torch.cat([1 - doubt, doubt[unsure]]),
            torch.cat([torch.arange(len(preferred), device=pair.device), unsure]),
        )

    def to(self, device: torch.device | str) -> "Comparisons":
        """The same comparisons on another device."""
        return Comparisons(
            self.preferred.to(device),
            self.other.to(device),
            self.case.to(device),
            self.num_cases,
            self.num_dropped,
            None if self.weight is None else self.weight.to(device),
            None if self.answer is None else self.answer.to(device),
        )

    def rows(self, index: Tensor) -> "Comparisons":
        """Some of the comparisons; cases keep their numbers, and nothing counts as dropped."""
        return Comparisons(
            self.preferred[index],
            self.other[index],
            self.case[index],
            self.num_cases,
            0,
            None if self.weight is None else self.weight[index],
            None if self.answer is None else self.answer[index].unique(return_inverse=True)[1],
        )

    def per_answer(self, value: Tensor) -> Tensor:
        """Weighted sums over the comparisons of the same answer, at each of them, ``[..., M]``."""
        value = self.weighted(value)
        if self.answer is None:
            return value
        total = value.new_zeros(*value.shape[:-1], int(self.answer.max()) + 1)
        return total.index_add_(-1, self.answer, value)[..., self.answer]


def _check_answers(answer: Tensor) -> None:
    """Raise for what is no ``Answer``, such as -1 and 1, or numbers of segments."""
    known = {int(one) for one in Answer}
    found = answer.unique().tolist()
    if answer.is_floating_point() or not known.issuperset(found):
        listed = ", ".join(f"{one}" for one in found[:6]) + (", ..." if len(found) > 6 else "")
        raise ValueError(
            "answers must be 0 where the first segment of a pair is preferred, 1 where the second "
            f"is, {int(Answer.TIE)} for a tie or {int(Answer.SKIP)} for none, as whole numbers, "
            f"got {answer.dtype} with values {listed}; of -1 and 1, or of numbers of segments, "
            "make the position of the preferred segment in its pair"
        )


def _named(rater: Tensor) -> Tensor:
    """Raters, with a number of its own for everybody unknown (-1), after the known ones."""
    unknown = rater < 0
    if not bool(unknown.any()):
        return rater
    own = int(rater.max()) + 1 + unknown.cumsum(0)
    return torch.where(unknown, own, rater)
