"""Predictors with a hypothesis of its own for each person: fine-tuned, or told by an encoder."""

from abc import ABC, abstractmethod
from collections.abc import Iterator

import torch
from torch import Tensor

from popl_rl.algorithms.lore import LoRe
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.specialists import specialists
from popl_rl.algorithms.vpl import VPL
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.people import Questions
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import MISTAKE, log_likelihood

__all__ = ["EncodedPredictor", "IndividualPredictor", "MixedPredictor"]

_CHUNK = 128  # people whose hypotheses are in memory at once


class _OwnHypothesis(ABC):
    """Judges each trial by a hypothesis of its own.

    Args:
        problem: What was learnt from, with segments of everybody's answers.
        comparisons: The answers that questions refer to.
        scale: Factor of the margins.
    """

    def __init__(self, problem: Problem, comparisons: Comparisons, *, scale: float = 1.0) -> None:
        self.problem, self.comparisons, self.scale = problem, comparisons, scale

    @abstractmethod
    def _population(self, questions: Questions, trials: slice, answers: int) -> Population:
        """The hypothesis of each trial."""

    def margins(self, questions: Questions, answers: int) -> Tensor:
        """Margins of the answers judged, ``[R, J]``."""
        return torch.cat(
            [self._chunk(questions, trials, answers) for trials in _chunks(len(questions))]
        )

    @torch.no_grad()
    def _chunk(self, questions: Questions, trials: slice, answers: int) -> Tensor:
        with torch.enable_grad():
            population = self._population(questions, trials, answers)
        rows = questions.judged[trials]
        pair = [self.comparisons.preferred[rows], self.comparisons.other[rows]]
        scores = self.problem.loss(population).scores(torch.cat(pair, 1))
        better, worse = scores.chunk(2, dim=1)
        return (better - worse).detach() * self.scale

    def __call__(self, questions: Questions, answers: int, /) -> tuple[Tensor, Tensor]:
        """See `popl_rl.evaluation.people.Predictor`."""
        margin = self.margins(questions, answers)
        return log_likelihood(margin, MISTAKE), (margin.sign() + 1) / 2


class IndividualPredictor(_OwnHypothesis):
    """One model per person: the hypothesis for all, fine-tuned on the person's answers alone.

    Args:
        problem: What the hypothesis for all was learnt from.
        comparisons: The answers that questions refer to.
        pooled: The hypothesis for all, a population of one.
        steps: Gradient steps for each person.
        scale: Factor of the margins.
        seed: Seed of the batches.
    """

    def __init__(
        self,
        problem: Problem,
        comparisons: Comparisons,
        pooled: Population,
        *,
        steps: int = 30,
        scale: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__(problem, comparisons, scale=scale)
        self.pooled, self.steps, self.seed = pooled, steps, seed

    def _population(self, questions: Questions, trials: slice, answers: int) -> Population:
        told = questions.told[trials].clamp(max=answers)
        count = len(told)
        if not bool(told.any()):
            return self.pooled.subset([0] * count)
        there = torch.arange(questions.asked.shape[1]) < told.unsqueeze(1)
        own = self.comparisons.rows(questions.asked[trials][there])
        trial = there.nonzero()[:, 0]
        # Nobody without an answer: everybody in a chunk has some, or is left out of the result.
        silent = (told == 0).nonzero()[:, 0]
        first = torch.zeros(len(silent), dtype=torch.long)
        said = Comparisons(
            torch.cat([own.preferred, own.preferred[first]]),
            torch.cat([own.other, own.preferred[first]]),
            torch.cat([trial, silent]),
            count,
        )
        return specialists(
            self.pooled,
            self.problem.loss(self.pooled),
            said,
            torch.arange(count),
            steps=self.steps,
            learning_rate=self.problem.training.learning_rate / 2,
            batch_size=16,
            generator=torch.Generator().manual_seed(self.seed + answers),
        )


class EncodedPredictor(_OwnHypothesis):
    """Variational preference learning: an encoder of the answers says what the person wants.

    Args:
        method: VPL, trained.
        comparisons: The answers that questions refer to.
        scale: Factor of the margins.
    """

    def __init__(self, method: VPL, comparisons: Comparisons, *, scale: float = 1.0) -> None:
        super().__init__(method.problem, comparisons, scale=scale)
        self.method = method

    @torch.no_grad()
    def _population(self, questions: Questions, trials: slice, answers: int) -> Population:
        told = questions.told[trials].clamp(max=answers)
        z = torch.zeros(len(told), self.method.latent)
        for count in told.unique().tolist():
            if not count:
                continue  # the prior's mean
            some = (told == count).nonzero()[:, 0]
            rows = questions.asked[trials][some, :count]
            said = self.comparisons
            z[some] = self.method.encoder(
                self.method.problem.bank, said.preferred[rows], said.other[rows]
            )[0]
        return self.method.policies_for(z)


class MixedPredictor(_OwnHypothesis):
    """Low-rank reward functions: the weights of a person are fitted to the person's answers.

    Args:
        method: LoRe, trained.
        comparisons: The answers that questions refer to.
        scale: Factor of the margins.
    """

    def __init__(self, method: LoRe, comparisons: Comparisons, *, scale: float = 1.0) -> None:
        super().__init__(method.problem, comparisons, scale=scale)
        self.method = method

    def _population(self, questions: Questions, trials: slice, answers: int) -> Population:
        asked, told = questions.asked[trials, :answers], questions.told[trials]
        there = torch.arange(asked.shape[1]) < told.unsqueeze(1)
        said = self.comparisons
        weights = self.method.fit(said.preferred[asked], said.other[asked], there)
        return self.method.mixtures(weights)


def _chunks(total: int) -> Iterator[slice]:
    for start in range(0, total, _CHUNK):
        yield slice(start, min(start + _CHUNK, total))
