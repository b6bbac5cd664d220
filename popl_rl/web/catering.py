"""Finding a person's policy: which question comes next, what is believed, what is served."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.data.pairs import draw_pairs, starts_of
from popl_rl.keys import ANSWER, PAIR, Answer
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.questions import Behaviours, best_question
from popl_rl.web.person_store import Asked, Person, PersonStore

__all__ = ["Agreement", "Caterer", "Found", "candidate_pairs"]


def candidate_pairs(
    segments: TensorDictBase, *, candidates: int, most: int, generator: torch.Generator
) -> Tensor:
    """Pairs to choose questions from, of few segments, since each must be rendered.

    Args:
        segments: TensorDict ``[N, T]``; where they say which state they go on from, only such from
            one state are paired.
        candidates: Pairs P to draw; the same pair may come twice.
        most: Segments in them at most, up to those of one state.
        generator: Source of the pairs.

    Returns:
        ``[P, 2]``.
    """
    start = starts_of(segments)
    if start is None:
        few = torch.randperm(len(segments), generator=generator)[: max(2, most)]
        return few[draw_pairs(len(few), candidates, generator=generator)]
    names, sizes = start.unique(return_counts=True)
    order = torch.randperm(len(names), generator=generator)
    fits = int((sizes[order].cumsum(0) <= most).sum())
    few = torch.isin(start, names[order[: max(1, fits)]]).nonzero()[:, 0]
    return few[draw_pairs(len(few), candidates, start=start[few], generator=generator)]


@dataclass(frozen=True)
class Found:
    """What is believed of a person.

    Attributes:
        weights: Belief in each member, ``[N]``.
        member: The one believed in most.
        is_over: Whether nothing more is to be asked.
    """

    weights: Tensor
    member: int
    is_over: bool


@dataclass(frozen=True)
class Agreement:
    """With how many strict answers hypotheses agree.

    Attributes:
        own: The person's member.
        everybody: The one for everybody.
        strict: Strict answers.
    """

    own: int
    everybody: int
    strict: int


class Caterer:
    """Questions, beliefs and policies for the people in a store.

    Args:
        policies: The set.
        segments: What is asked about, ``[N, T]``, as learners read them.
        pairs: Candidates ``[P, 2]``.
        everybody: A single hypothesis, the one for everybody.
        store: People and their answers.
        questions: Most questions of a person.
        enough: Belief in one behaviour from which on nothing is asked.
        further: Random pairs to be asked afterwards.
    """

    def __init__(
        self,
        policies: HypothesisSet,
        segments: TensorDictBase,
        pairs: Tensor,
        *,
        everybody: HypothesisSet,
        store: PersonStore,
        questions: int,
        enough: float,
        further: int,
    ) -> None:
        self.policies, self.everybody, self.store = policies, everybody, store
        self.questions, self.enough, self.further = questions, enough, further
        # Each pair once: what was asked is then known by its place.
        self.pairs = pairs.sort(-1).values.unique(dim=0)
        used = self.pairs.unique()
        self._row = {int(segment): row for row, segment in enumerate(used.tolist())}
        self._used, self._segments = used, segments[used]
        every = Comparisons(
            torch.searchsorted(used, self.pairs[:, 0].contiguous()),
            torch.searchsorted(used, self.pairs[:, 1].contiguous()),
            torch.arange(len(self.pairs)),
            len(self.pairs),
        )
        self.margin = policies.margins(self._segments, every).cpu()
        self._for_all = everybody.margins(self._segments, every).cpu()[0]
        self.behaviours = Behaviours(self.margin)
        self._place = {(a, b): place for place, (a, b) in enumerate(self.pairs.tolist())}

    def found(self, asked: Sequence[Asked]) -> Found:
        """What is believed after what a person was asked before a policy was served."""
        known = [one for one in asked if not one.further and one.answer is not None]
        strict = [one for one in known if one.answer in (Answer.FIRST, Answer.SECOND)]
        weights = torch.full((len(self.policies),), 1 / len(self.policies))
        if strict:
            answers = TensorDict(
                {
                    PAIR: torch.tensor(
                        [[self._row[one.first], self._row[one.second]] for one in strict]
                    ),
                    ANSWER: torch.tensor([one.answer for one in strict]),
                },
                [len(strict)],
            )
            weights = self.policies.cater(self._segments, answers).weights
        certain = float(self.behaviours.belief(weights).max()) >= self.enough
        over = certain or len(known) >= self.questions or len(known) >= len(self.pairs)
        return Found(weights, int(weights.argmax()), over)

    def next_question(self, person: Person) -> Asked | None:
        """What a person is asked now, the same until it is answered; None if enough is known."""
        asked = self.store.asked(person)
        if asked and asked[-1].answer is None:
            return asked[-1]
        if any(one.further for one in asked) or self.store.served(person) is not None:
            return None
        found = self.found(asked)
        if found.is_over:
            return None
        index, _ = best_question(self.behaviours, found.weights, self._open(asked))
        return self.store.ask(person, self._shown(person, index, asked), further=False)

    def further_question(self, person: Person) -> Asked | None:
        """A random pair for a person who was served; None if all of these were asked."""
        asked = self.store.asked(person)
        if asked and asked[-1].answer is None:
            return asked[-1]
        open_ = self._open(asked)
        if sum(one.further for one in asked) >= self.further or not bool(open_.any()):
            return None
        generator = self._draw(person, asked)
        index, _ = best_question(
            self.behaviours,
            torch.full((len(self.policies),), 1 / len(self.policies)),
            open_,
            rule="uniform",
            generator=generator,
        )
        return self.store.ask(person, self._shown(person, index, asked), further=True)

    def agreement(self, asked: Sequence[Asked], member: int, *, further: bool) -> Agreement:
        """With how many of a person's strict answers a member and the one for all agree."""
        own = everybody = strict = 0
        for one in asked:
            if one.further != further or one.answer not in (Answer.FIRST, Answer.SECOND):
                continue
            low, high = sorted((one.first, one.second))
            place = self._place[low, high]
            prefers_low = (one.answer == Answer.FIRST) == (one.first == low)
            own += bool(self.margin[member, place] > 0) == prefers_low
            everybody += bool(self._for_all[place] > 0) == prefers_low
            strict += 1
        return Agreement(own, everybody, strict)

    def serve(self, person: Person) -> Found:
        """What a person is served; kept the first time, and the same from then on."""
        found = self.found(self.store.asked(person))
        served = self.store.serve(person, found.member, float(found.weights[found.member]))
        return Found(found.weights, served.member, True)

    def favourites(self, member: int | None, *, count: int = 3) -> list[int]:
        """Segments of the candidates that a member, or the one for all (None), likes best.

        Those that win most of their comparisons with others, by the member's margins.
        """
        wins = torch.zeros(len(self._used))
        times = torch.zeros(len(self._used))
        places = torch.searchsorted(self._used, self.pairs)
        margin = self._for_all if member is None else self.margin[member]
        first = (margin > 0).float()
        for side, won in ((0, first), (1, 1 - first)):
            wins.index_add_(0, places[:, side], won)
            times.index_add_(0, places[:, side], torch.ones(len(won)))
        share = (wins + 1) / (times + 2)
        best = share.topk(min(count, len(share))).indices
        return [int(segment) for segment in self._used[best]]

    def rows(self) -> list[dict[str, Any]]:
        """A row for every person, for researchers."""
        rows = []
        for person, began in self.store.people():
            asked, served = self.store.asked(person), self.store.served(person)
            row: dict[str, Any] = {"person": person.id, "began": round(began, 1)}
            row["answers"] = sum(not one.further and one.answer is not None for one in asked)
            member = None if served is None else served.member
            row["member"], row["belief"] = member, None if served is None else served.belief
            row["suits"] = None if served is None else served.suits
            later = None if member is None else self.agreement(asked, member, further=True)
            row["later_answers"] = 0 if later is None else later.strict
            row["agree"] = 0 if later is None else later.own
            row["agree_everybody"] = 0 if later is None else later.everybody
            rows.append(row)
        return rows

    def _open(self, asked: Sequence[Asked]) -> Tensor:
        open_ = torch.ones(len(self.pairs), dtype=torch.bool)
        for one in asked:
            low, high = sorted((one.first, one.second))
            open_[self._place[low, high]] = False
        return open_

    def _draw(self, person: Person, asked: Sequence[Asked]) -> torch.Generator:
        return torch.Generator().manual_seed(1000 * person.id + len(asked))

    def _shown(self, person: Person, index: int, asked: Sequence[Asked]) -> tuple[int, int]:
        """A pair in a random order."""
        first, second = self.pairs[index].tolist()
        swap = bool(torch.rand((), generator=self._draw(person, asked)) < 0.5)
        return (second, first) if swap else (first, second)
