"""Preferences in the form a learner reads: no group, no utility, no rater model."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import ANSWER, CHANCE, PAIR, RANKING, RATER, Answer

__all__ = ["Comparisons", "Grouped"]

_ALL = slice(None)
_NUMBERS = 2**22  # of members and comparisons that are looked at together


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
    2.2.3). They are comparisons of the same case. Under a model of draws (Rao and Kupper, 1967) the
    two comparisons of a tie are ``tied`` instead.

    A ranking of several items is the comparisons of each item with all behind it: those of one item
    are a stage, which counts 1 in all (Plackett, 1975; Luce, 1959). How likely stages and ties are:
    ``popl_rl.models.preference_likelihood``.

    Attributes:
        preferred: Segment that was preferred, ``[M]``.
        other: Segment it was preferred to, ``[M]``.
        case: What lexicase filters on: the rater's number, or the preference's own, ``[M]``.
        num_cases: Number of cases C.
        num_dropped: Ties and skips that were left out.
        weight: How much each comparison counts, ``[M]`` in (0, 1]; None if all count 1.
        answer: Number of the answer that each comparison is of, ``[M]``, the same for the two
            comparisons of one answer and for those of one ranking; None if every comparison is an
            answer.
        stage: Number of the stage that each comparison is of, ``[M]``; None without rankings.
        tied: Which comparisons are halves of ties, ``[M]`` bool; None without a model of draws.
        threshold: Of the model of draws, in units of margins: equally good segments are a tie with
            the chance ``tanh(threshold / 2)``.
    """

    preferred: Tensor
    other: Tensor
    case: Tensor
    num_cases: int
    num_dropped: int = 0
    weight: Tensor | None = None
    answer: Tensor | None = None
    stage: Tensor | None = None
    tied: Tensor | None = None
    threshold: float = 0.0

    def __len__(self) -> int:
        return len(self.preferred)

    @cached_property
    def num_answers(self) -> int:
        """Answers that the comparisons are of: a ranking is one, and so is a tie."""
        return len(self) if self.answer is None else int(self.answer.max()) + 1

    @property
    def is_single(self) -> bool:
        """Whether every case is a single answer, as where nobody kept rater ids."""
        return self.num_cases == self.num_answers

    def weighted(self, value: Tensor, part: slice = _ALL) -> Tensor:
        """Values of comparisons ``[..., M]``, or of a part of them, times how much each counts."""
        return value if self.weight is None else value * self.weight[part]

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

    @cached_property
    def stages(self) -> Tensor:
        """Comparisons of each stage, ``[S, J]``, -1 behind the last; worked out once."""
        assert self.stage is not None
        order, size = self.stage.argsort(stable=True), self.stage.bincount()
        place = torch.arange(len(order), device=order.device)
        place = place - (size.cumsum(0) - size).repeat_interleave(size)
        rows = order.new_full((len(size), int(size.max())), -1)
        return rows.index_put((self.stage[order], place), order)

    @property
    def all_strict(self) -> bool:
        """Whether each comparison is judged by itself: no stages, and no ties of a model."""
        return self.stage is None and self.tied is None

    def together(self, index: Tensor) -> Tensor:
        """Comparisons without which some cannot be judged: of a stage, all of it.

        Args:
            index: Comparisons ``[..., B]``.

        Returns:
            The same; with rankings, J for each, ``[..., B * J]``, itself where its stage has fewer.
        """
        if self.stage is None:
            return index
        rows = self.stages[self.stage[index]]
        return torch.where(rows < 0, index.unsqueeze(-1), rows).flatten(-2)

    def segments(self, total: int) -> Tensor:
        """Which of ``total`` segments some comparison is about, ascending."""
        is_used = torch.zeros(total, dtype=torch.bool, device=self.preferred.device)
        is_used[self.preferred] = True
        is_used[self.other] = True
        return is_used.nonzero()[:, 0]

    def blocks(self, size: int) -> Iterator[slice]:
        """Slices of at most ``size`` comparisons, all of them one after the other."""
        for start in range(0, len(self), size):
            yield slice(start, min(start + size, len(self)))

    def answer_blocks(self, members: int) -> Iterator[slice]:
        """Slices so small that a number for each of some members and comparisons takes 16 MB.

        Comparisons of one answer stay together: where there are such, all are in one slice.
        """
        alone = self.answer is None and self.stage is None
        return self.blocks(max(1, _NUMBERS // members) if alone else max(1, len(self)))

    @classmethod
    def from_preferences(
        cls,
        preferences: TensorDictBase,
        *,
        cases: str,
        ties: Literal["drop", "count", "rao_kupper"] = "drop",
    ) -> "Comparisons":
        """Keep the strict answers; or also ties and soft labels, as what they say.

        Args:
            preferences: TensorDict ``[M]`` with ``pair``, ``answer`` and, for rater cases,
                ``rater``. A rater of -1 is unknown: each such answer or ranking is a case of its
                own.
            cases: ``"preference"`` or ``"rater"``.
            ties: ``"drop"``: ties are left out, soft labels count as the answer that they are
                nearer to. ``"count"``: both count by halves, or by their ``chance``; with a case
                for each rater only, since halves of one answer are no cases. ``"rao_kupper"``: the
                same, but ties are answers of a model of draws, whose threshold is at first the
                likeliest of somebody who finds everything equally good.

        Beside rankings, ties are left out whatever ``ties`` says.

        Returns:
            The M' strict ones, each with its case; raters' cases are numbered from 0. Without
            raters, a ranking is a case.

        Raises:
            ValueError: If ``cases`` or ``ties`` is none of these, rater ids are needed and
                missing, answers are no ``popl_rl.keys.Answer``, no answer is strict, or a ranking
                holds ties, skips or soft labels, or is of several raters.
        """
        _check_arguments(preferences, cases, ties)
        answer = preferences[ANSWER]
        _check_answers(answer)
        ranking = _rankings(preferences)
        counting = ties != "drop" and cases == "rater" and ranking is None
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
            own = None if ranking is None else _answers_of(ranking[kept])
            case = _named(preferences[RATER][kept], own).unique(return_inverse=True)[1]
        count, dropped = int(case.max()) + 1, int((~kept).sum())
        doubt = torch.minimum(chance, 1 - chance)
        unsure = (doubt > 0).nonzero().squeeze(-1)
        if ranking is not None:
            found = cls(preferred, other, case, count, dropped)
            return _ranked(found, ranking[kept], is_case=cases == "preference")
        if not len(unsure):
            return cls(preferred, other, case, count, dropped)
        found = cls(
            torch.cat([preferred, other[unsure]]),
            torch.cat([other, preferred[unsure]]),
            torch.cat([case, case[unsure]]),
            count,
            dropped,
            torch.cat([1 - doubt, doubt[unsure]]),
            torch.cat([torch.arange(len(preferred), device=pair.device), unsure]),
        )
        tied = said == Answer.TIE
        if ties == "count" or not tied.any():
            return found
        share = float(tied.double().mean())
        tied = torch.cat([tied, tied[unsure]])
        return replace(found, tied=tied, threshold=2 * math.atanh(share))

    def to(self, device: torch.device | str) -> "Comparisons":
        """The same comparisons on another device."""
        return self._each(lambda value: value.to(device))

    def rows(self, index: Tensor) -> "Comparisons":
        """Some of the comparisons; cases keep their numbers, and nothing counts as dropped.

        Of a stage of which some comparisons are taken, these are a stage among fewer.
        """
        found = self._each(lambda value: value[index])
        answer, stage = (
            None if value is None else value.unique(return_inverse=True)[1]
            for value in (found.answer, found.stage)
        )
        return replace(found, num_dropped=0, answer=answer, stage=stage)

    def scaled(self, factor: float) -> "Comparisons":
        """The same for margins that are multiplied by a factor: what is a tie stays one."""
        return replace(self, threshold=factor * self.threshold)

    def _each(self, change: Callable[[Tensor], Tensor]) -> "Comparisons":
        """The same with every tensor changed."""
        tensors = {
            field.name: change(value)
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), Tensor)
        }
        return replace(self, **tensors)  # type: ignore[arg-type]

    def per_answer(self, value: Tensor, part: slice = _ALL) -> Tensor:
        """Weighted sums over the comparisons of the same answer, at each of them, ``[..., M]``.

        Args:
            value: Of all comparisons, or of a part.
            part: One of ``answer_blocks``.
        """
        value = self.weighted(value, part)
        if self.answer is None:
            return value
        total = value.new_zeros(*value.shape[:-1], int(self.answer.max()) + 1)
        return total.index_add_(-1, self.answer, value)[..., self.answer]


def _check_arguments(preferences: TensorDictBase, cases: str, ties: str) -> None:
    """Raise for unknown words, and where rater ids are needed and missing."""
    if cases not in ("preference", "rater"):
        raise ValueError(f"cases must be 'preference' or 'rater', got {cases!r}")
    if ties not in ("drop", "count", "rao_kupper"):
        raise ValueError(f"ties must be 'drop', 'count' or 'rao_kupper', got {ties!r}")
    if cases == "rater" and RATER not in preferences.keys():  # noqa: SIM118 - not a dict
        raise ValueError(
            "preferences must hold 'rater', the id of who answered, for cases='rater'; without "
            "ids use cases='preference'"
        )


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


def _named(rater: Tensor, answer: Tensor | None) -> Tensor:
    """Raters, with a number of its own for everybody unknown (-1), after the known ones.

    Everybody unknown has given one ``answer``, which with rankings is several comparisons.
    """
    unknown = rater < 0
    if not bool(unknown.any()):
        return rater
    own = int(rater.max()) + 1 + (unknown.cumsum(0) if answer is None else answer)
    return torch.where(unknown, own, rater)


def _rankings(preferences: TensorDictBase) -> Tensor | None:
    """Ranking of each preference, if there are any, each of strict answers of one rater."""
    ranking: Tensor | None = preferences.get(RANKING, None)
    if ranking is None or not bool((ranking >= 0).any()):
        return None
    chance = preferences.get(CHANCE, None)
    wrong = (preferences[ANSWER] > Answer.SECOND) & (ranking >= 0)
    if chance is not None or bool(wrong.any()):
        raise ValueError(
            "rankings must consist of strict answers (0 or 1), and no soft labels may be beside "
            f"them, got {int(wrong.sum())} ties and skips in rankings"
            f"{'' if chance is None else ' and soft labels'}; leave such rankings out"
        )
    rater = preferences.get(RATER, None)
    if rater is not None:
        number = torch.stack([ranking, rater])[:, ranking >= 0].unique(dim=1)[0]
        if len(shared := number[1:][number.diff() == 0]):
            raise ValueError(
                f"a ranking must be of one rater, got {RANKING} {int(shared[0])} for several; "
                "number rankings over all raters"
            )
    return ranking


def _answers_of(ranking: Tensor) -> Tensor:
    """Number of the answer that each comparison is of: its ranking, or it alone."""
    own = int(ranking.max()) + 1 + torch.arange(len(ranking), device=ranking.device)
    number: Tensor = torch.where(ranking < 0, own, ranking).unique(return_inverse=True)[1]
    return number


def _ranked(said: Comparisons, ranking: Tensor, *, is_case: bool) -> Comparisons:
    """Strict answers, with the rankings and stages that they are part of."""
    answer = _answers_of(ranking)
    stage = torch.stack([answer, said.preferred]).unique(dim=1, return_inverse=True)[1]
    return replace(
        said,
        case=answer if is_case else said.case,
        num_cases=int(answer.max()) + 1 if is_case else said.num_cases,
        weight=1.0 / stage.bincount()[stage],
        answer=answer,
        stage=stage,
    )
