"""New people whom nobody knows a group of: how well are their further answers predicted?

Of each held-out person some answers are asked about, the first K of them told to whoever predicts,
and others are kept to judge by, the same whatever K is. No group, no utility and no model of a
rater is needed, so that all of this can be found out about real people.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.models.preference_likelihood import MISTAKE, log_likelihood

__all__ = ["Predictor", "Questions", "SetPredictor", "ToldPredictor", "draw_questions", "judge"]

_LOG_HALF = -0.6931471805599453


@dataclass(frozen=True)
class Questions:
    """Which answers of which person are told, and which are to be predicted.

    Attributes:
        person: Case of each of R trials, ``[R]``; a person may have several.
        asked: Comparisons that are told, in this order, ``[R, K]``.
        told: How many of them there are, ``[R]``.
        judged: Comparisons that are to be predicted, ``[R, J]``.
        mask: Which of these there are, ``[R, J]`` bool.
    """

    person: Tensor
    asked: Tensor
    told: Tensor
    judged: Tensor
    mask: Tensor

    def __len__(self) -> int:
        return len(self.person)


def draw_questions(
    comparisons: Comparisons,
    people: Sequence[int],
    *,
    most: int = 20,
    repeats: int = 1,
    most_judged: int = 50,
    generator: torch.Generator,
) -> Questions:
    """Divide people's answers into those that are told and those that are judged by.

    A quarter of a person's answers is judged by at least, and all that are left beyond ``most``.

    Args:
        comparisons: Strict answers and the person of each.
        people: Cases of the people, each with two answers or more.
        most: Answers that are told at most.
        repeats: Random divisions of each person's answers.
        most_judged: Answers of a person that are judged by at most.
        generator: Source of the divisions.

    Returns:
        ``len(people) * repeats`` trials.

    Raises:
        ValueError: If somebody has fewer than two answers.
    """
    order = comparisons.case.argsort(stable=True)
    size = comparisons.case.bincount(minlength=comparisons.num_cases)
    begin = (size.cumsum(0) - size).tolist()
    trials = [(case, int(size[case])) for case in people for _ in range(repeats)]
    few = [case for case, count in trials if count < 2]
    if few or not trials:
        raise ValueError(
            f"people must have two answers or more to be judged, got {len(set(few))} of "
            f"{len(people)} with fewer; hold out others"
        )
    told, judged = [], []
    for case, count in trials:
        own = order[begin[case] : begin[case] + count]
        own = own[torch.randperm(count, generator=generator)]
        if comparisons.stage is not None:
            own = _whole_rankings(comparisons, own)
        kept = max(-(-count // 4), count - most)
        asked, rest = own.split([count - kept, kept])
        if comparisons.stage is not None:
            asked, rest = _apart(comparisons, asked, rest)
        told.append(asked)
        judged.append(rest[:most_judged])
    pad = torch.nn.utils.rnn.pad_sequence
    sizes = torch.tensor([len(rows) for rows in judged])
    padded = pad(judged, batch_first=True)
    return Questions(
        torch.tensor([case for case, _ in trials]),
        pad(told, batch_first=True),
        torch.tensor([len(rows) for rows in told]),
        padded,
        torch.arange(padded.shape[1]) < sizes.unsqueeze(1),
    )


def _apart(comparisons: Comparisons, asked: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """What is told and what is judged by, without the ranking that is in both of them.

    It is told, unless nothing would be left to judge by.
    """
    numbers = _answers_of(comparisons, asked), _answers_of(comparisons, rest)
    new = ~torch.isin(numbers[1], numbers[0])
    if new.any():
        return asked, rest[new]
    return asked[~torch.isin(*numbers)], rest


def _answers_of(comparisons: Comparisons, rows: Tensor) -> Tensor:
    """Number of the answer, such as a ranking, that each comparison is of."""
    assert comparisons.answer is not None
    return comparisons.answer[rows]


def _whole_rankings(comparisons: Comparisons, rows: Tensor) -> Tensor:
    """Comparisons in such an order that those of a ranking follow each other."""
    number = _answers_of(comparisons, rows).unique(return_inverse=True)[1]
    place = torch.arange(len(rows))
    first = torch.full_like(place, len(rows)).scatter_reduce(0, number, place, "amin")
    return rows[first[number].argsort(stable=True)]


class Predictor(Protocol):
    """Predicts a person's further answers."""

    def __call__(self, questions: Questions, answers: int, /) -> tuple[Tensor, Tensor]:
        """Predict after some answers.

        Args:
            questions: R trials.
            answers: How many of the answers asked are told; of trials that have fewer, all.

        Returns:
            Log-chance of each answer judged, ``[R, J]``, and whether it was right, ``[R, J]``
            (1/2 where the prediction is a toss-up).
        """
        ...


class SetPredictor:
    """Predicts with a set of hypotheses, by a belief in each that answers change.

    Args:
        margin: Margins of the N hypotheses on M comparisons, in the scale in which they are
            believed, ``[N, M]``.
        log_prior: Belief in each before any answer, ``[N]`` log-weights; equal if None.
        mix: Predict by all hypotheses as much as they are believed in; else by the one that is
            believed in most, as catering does.
        mistake: Chance that an answer is a slip.
    """

    def __init__(
        self,
        margin: Tensor,
        *,
        log_prior: Tensor | None = None,
        mix: bool = False,
        mistake: float = MISTAKE,
    ) -> None:
        self.margin = margin
        self.likelihood = log_likelihood(margin, mistake)
        count = len(margin)
        self.log_prior = margin.new_zeros(count) if log_prior is None else log_prior
        self.mix = mix

    def belief(self, questions: Questions, answers: int) -> Tensor:
        """Log-weights of the hypotheses, summing to 1, ``[R, N]``."""
        there = torch.arange(questions.asked.shape[1]) < questions.told.unsqueeze(1)
        there[:, answers:] = False
        evidence = (self.likelihood[:, questions.asked] * there).sum(-1).T
        return (self.log_prior + evidence).log_softmax(-1)

    def __call__(self, questions: Questions, answers: int, /) -> tuple[Tensor, Tensor]:
        """See `Predictor`."""
        belief = self.belief(questions, answers)
        if self.mix:
            each = self.likelihood[:, questions.judged].transpose(0, 1)
            chance = (belief.unsqueeze(-1) + each).logsumexp(1)
            return chance, _right(chance - _LOG_HALF)
        chosen = belief.argmax(-1, keepdim=True)
        chance = self.likelihood[chosen, questions.judged]
        return chance, _right(self.margin[chosen, questions.judged])


class ToldPredictor:
    """Predicts by the hypothesis of the condition that a person is of: it is told which.

    Args:
        margin: Margins of the G conditions' hypotheses on M comparisons, ``[G, M]``.
        hypothesis: Which is each person's, by case, ``[C]``.
    """

    def __init__(self, margin: Tensor, hypothesis: Tensor) -> None:
        self.margin, self.hypothesis = margin, hypothesis

    def __call__(self, questions: Questions, answers: int, /) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        """See `Predictor`; the answers told are not needed."""
        own = self.margin[self.hypothesis[questions.person].unsqueeze(1), questions.judged]
        return log_likelihood(own, MISTAKE), _right(own)


def _right(margin: Tensor) -> Tensor:
    return (margin.sign() + 1) / 2


def judge(
    predictor: Predictor, questions: Questions, *, answers: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Accuracy and log-likelihood of each person after some answers.

    People who have fewer answers to tell are left out.

    Args:
        predictor: Who predicts.
        questions: What is told and what is judged by.
        answers: Answers that are told.

    Returns:
        Cases of the P people, their accuracy and the mean log-likelihood of their further answers,
        each ``[P]``, averaged over the trials of each.
    """
    right, likely = predictor(questions, answers)[::-1]
    enough = questions.told >= answers
    size = questions.mask.sum(1).clamp(min=1)
    values = [(each * questions.mask).sum(1) / size for each in (right.float(), likely)]
    people, place = questions.person[enough].unique(return_inverse=True)
    count = place.bincount(minlength=len(people)).clamp(min=1)
    means = [torch.zeros(len(people)).index_add_(0, place, each[enough]) / count for each in values]
    return people, means[0], means[1]
