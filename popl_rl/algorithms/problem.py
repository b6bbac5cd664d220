"""What every method is given, and what every method is: ``Problem`` and ``Method``."""

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.config import Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.calibration import fit_scale
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import Spec
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import InParts, answer_likelihood
from popl_rl.models.scoring import PassShares, margins_of, pass_shares, segment_scores
from popl_rl.models.sets import as_set
from popl_rl.models.style_codes import StyleClone
from popl_rl.models.style_population import StyledPopulation

__all__ = ["Method", "Problem"]


@dataclass(frozen=True)
class Problem:
    """What every method is given, and nothing more: no group, no utility, no rater model.

    Attributes:
        spec: Sizes and kind of the hypotheses.
        bank: N segments.
        comparisons: M strict preferences and the case of each.
        training: The recipe; the same object for every method, the oracle and pooled CPL.
        clone: What members are style codes of; they are networks if None.
        evolve: ``"all"``: members are whole networks. ``"head"``: last layers on a shared trunk.
        members: Hypotheses in the population.
        generations: Generations that the steps of the training are divided into.
    """

    spec: Spec
    bank: SegmentBank
    comparisons: Comparisons
    training: Training = field(default_factory=Training)
    clone: StyleClone | None = None
    evolve: Literal["all", "head"] = "all"
    members: int = 32
    generations: int = 100

    @property
    def device(self) -> torch.device:
        """Where the segments are, and where members are to be trained."""
        return self.bank.row.device

    @property
    def block(self) -> int:
        """CPL steps of a generation, at least 1."""
        return max(1, round(self.training.steps / self.generations))

    @property
    def conservatism(self) -> float:
        """Lambda of the CPL loss, as this kind of hypotheses takes it."""
        return self.spec.conservatism(self.training.conservatism)

    def initial_population(self, count: int, *, generator: torch.Generator) -> Population:
        """Fresh members: networks or heads, or codes of the data's segments if there is a clone.

        Args:
            count: Number of members.
            generator: Source of initial weights, or of the codes.
        """
        if self.clone is not None:
            return StyledPopulation(self.clone, self.clone.draw(count, generator=generator))
        population = Population.create(self.spec, count, evolve=self.evolve, generator=generator)
        return population.to(self.device)

    def typical_population(self, count: int, *, generator: torch.Generator) -> Population:
        """Members that nobody was asked about: fresh whole networks, or the data's typical code."""
        if self.clone is not None:
            return StyledPopulation(self.clone, self.clone.typical().expand(count, -1))
        return Population.create(self.spec, count, generator=generator).to(self.device)

    def loss(self, population: Population, *, cloning: bool = True) -> CPLLoss:
        """The CPL loss of a population under the recipe.

        Args:
            population: N members.
            cloning: Whether the recipe's behaviour cloning is part of it.
        """
        return CPLLoss(
            population,
            self.bank,
            alpha=self.training.alpha,
            conservatism=self.conservatism,
            discount=self.training.discount,
            slip=self.training.slip,
            bc=self.spec.cloning(self.training.bc) if cloning else 0.0,
        )

    def scores(self, population: Population) -> Tensor:
        """Score of every segment in the eyes of every member, ``[N, segments]``."""
        return segment_scores(
            population, self.bank, alpha=self.training.alpha, discount=self.training.discount
        )

    def compared_scores(self, population: Population) -> Tensor:
        """As ``scores``, of segments that comparisons are about; others may be NaN."""
        return segment_scores(
            population,
            self.bank,
            alpha=self.training.alpha,
            discount=self.training.discount,
            wanted=self._compared,
        )

    @cached_property
    def _compared(self) -> Tensor:
        return self.comparisons.segments(len(self.bank))

    def margins(self, population: Population) -> Tensor:
        """Margins ``S(sigma+) - S(sigma-)`` of every member on every comparison, ``[N, M]``."""
        return margins_of(self.compared_scores(population), self.comparisons)

    def pass_shares(self, population: Population) -> PassShares:
        """Which share of each case's comparisons each member passes."""
        return pass_shares(self.compared_scores(population), self.comparisons)

    def likelihood(self, scores: Tensor) -> Tensor:
        """Log-likelihood of every answer, the one that every method here maximises.

        The response model with slips on CPL's conservative margins, ``log p(Delta)`` with ``Delta =
        S(sigma+) - lambda S(sigma-)`` and ``p = (1 - slip) sigmoid(Delta) + slip sigmoid(-Delta)``:
        the CPL loss with the opposite sign, so that E-steps and gradient steps agree.

        Args:
            scores: As of ``compared_scores``, ``[N, segments]``.

        Returns:
            ``[N, M]``.
        """
        return self._likelihood_of(scores, slice(None))

    def likelihood_in_parts(self, scores: Tensor) -> InParts:
        """As ``likelihood``, of a part of the comparisons at a time."""
        return InParts(len(scores), partial(self._likelihood_of, scores))

    def _likelihood_of(self, scores: Tensor, part: slice) -> Tensor:
        comparisons = self.comparisons
        other = self.conservatism * scores[:, comparisons.other[part]]
        margin = scores[:, comparisons.preferred[part]] - other
        return answer_likelihood(margin, comparisons, self.training.slip, part)

    def hypothesis_set(self, population: Population) -> HypothesisSet:
        """A population as a set to cater from."""
        return as_set(population, alpha=self.training.alpha, discount=self.training.discount)

    def calibrated(self, found: HypothesisSet) -> HypothesisSet:
        """The same set with scores of the scale under which catering predicts answers best."""
        scores = segment_scores(
            found.population,
            self.bank,
            alpha=found.alpha,
            discount=found.discount,
            wanted=self._compared,
        )
        margin = InParts(len(found), partial(margins_of, scores, self.comparisons))
        found.alpha *= fit_scale(margin, self.comparisons)
        return found

    def distinct(self, population: Population) -> HypothesisSet:
        """One member for each behaviour, pass or not on every comparison, as a set."""
        return self.hypothesis_set(population).distinct(self.bank, self.comparisons)


class Method(Protocol):
    """What learns a set of hypotheses, generation by generation.

    A class is built as ``Factory(problem, generator=generator, **sections, **options)``: sections
    are the dataclasses of ``popl_rl.config`` that ``method.reads`` names, beside ``training``,
    which is in the problem; options are ``method.options``.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.
    """

    generation: int
    generations: int

    @property
    def population(self) -> Population:
        """The hypotheses as they are now."""
        ...

    def step(self) -> dict[str, float]:
        """Run one generation and return scalars to log, among them ``worst_rater_accuracy``."""
        ...

    def result(self) -> HypothesisSet:
        """The set that has been found, after the last generation."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        ...
