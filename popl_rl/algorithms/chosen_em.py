"""EM that is not told how many groups there are: raters who are held out choose the number.

Mixtures of 1, 2, 3, 5, 8, ... components are trained for a while on four raters out of five. The
others tell which number predicts people whom it has not learnt of best, and the smallest that is
hardly worse is taken, by the same rule as in ``popl_rl.algorithms.niches``. Then a mixture of that
size is trained by the whole recipe on everybody. What `EM` loses against this is being told.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.em import EM
from popl_rl.algorithms.needed import (
    behind_best,
    predicted,
    sizes_up_to,
    standard_error,
    sufficient,
)
from popl_rl.algorithms.problem import Problem
from popl_rl.config import EMSettings
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import answer_likelihood

__all__ = ["ChosenEM"]

_SEARCH = 0.3  # of the recipe's generations and steps, in which mixtures of all sizes train
_HELD_OUT = 5  # one rater in so many is held out of the search
_EVIDENCE = 0.5  # standard errors by which a smaller mixture may predict raters worse
_NEGLIGIBLE = 0.002  # nats of an answer that are not worth a component, whatever the evidence


class ChosenEM:
    """One generation after the other: mixtures of several sizes, then one of the chosen size.

    Args:
        problem: What is to be learnt; its cases are raters. Each size has as many starts as there
            is room for among ``problem.members``.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished: of the search, and the problem's.
        sizes: What was compared, ``(components, mean log-likelihood of held-out raters' answers,
            standard error of how far that is behind the best, paired over raters)``; empty before.

    Raises:
        ValueError: If there is a single rater.
    """

    def __init__(self, problem: Problem, *, generator: torch.Generator) -> None:
        raters = problem.comparisons.num_cases
        if raters < 2:
            raise ValueError(
                "EM that chooses its size needs at least 2 raters, to hold some out, got 1; with "
                "one rater there are no groups to find: take method=cpl"
            )
        self.problem, self.generator = problem, generator
        self.generation = 0
        self.settled = max(1, round(_SEARCH * problem.generations))
        self.generations = self.settled + problem.generations
        self.sizes: list[tuple[int, float, float]] = []
        order = torch.randperm(raters, generator=generator, device=problem.device)
        aside = (order % _HELD_OUT == 0)[problem.comparisons.case]
        kept, judged = ((~aside).nonzero()[:, 0], aside.nonzero()[:, 0])
        steps = max(1, round(_SEARCH * problem.training.steps))
        search = replace(
            problem,
            comparisons=problem.comparisons.rows(kept),
            training=replace(problem.training, steps=steps),
            generations=self.settled,
        )
        self.judged = replace(problem, comparisons=problem.comparisons.rows(judged))
        self.mixtures = [
            EM(search, em=EMSettings(groups=size), generator=generator)
            for size in sizes_up_to(problem.members)
        ]
        self.found: EM | None = None

    def step(self) -> dict[str, float]:
        """Run one generation: of every mixture before the size is chosen, of one after that.

        Returns:
            Scalars to log, see ``EM.step``; before the choice those of the largest mixture.
        """
        if self.generation == self.settled:
            self._settle()
        learning = self.mixtures if self.found is None else [self.found]
        for mixture in learning:
            metrics = mixture.step()
        self.generation += 1
        return metrics

    @property
    def population(self) -> Population:
        """The components as they are now; before the choice those of the largest mixture.

        The first ones come again where there are fewer than ``problem.members``: tables have a
        column for each member.
        """
        now = (self.mixtures[-1] if self.found is None else self.found).population
        return now.subset([index % len(now) for index in range(self.problem.members)])

    def result(self) -> HypothesisSet:
        """The components of the likeliest mixture of the chosen size, scaled for catering."""
        return (self.mixtures[-1] if self.found is None else self.found).result()

    def _settle(self) -> None:
        value = torch.stack([self._value(mixture.result().population) for mixture in self.mixtures])
        behind = behind_best(value)
        size = [mixture.share.shape[1] for mixture in self.mixtures]
        mean, error = value.mean(1).tolist(), standard_error(behind).tolist()
        self.sizes = list(zip(size, mean, error, strict=True))
        chosen = sufficient(behind, evidence=_EVIDENCE, negligible=_NEGLIGIBLE)
        self.found = self._mixture(size[chosen])

    def _mixture(self, groups: int) -> EM:
        return EM(self.problem, em=EMSettings(groups=groups), generator=self.generator)

    def _value(self, population: Population) -> Tensor:
        """How well a mixture predicts each rater who was held out, ``[held-out raters]``."""
        comparisons, slip = self.judged.comparisons, self.problem.training.slip
        likelihood = answer_likelihood(self.judged.margins(population), comparisons, slip)
        return predicted(likelihood, comparisons)[comparisons.case.unique()]

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        found = self.found
        return {
            "generation": self.generation,
            "mixtures": [] if found else [mixture.state_dict() for mixture in self.mixtures],
            "groups": 0 if found is None else found.share.shape[1],
            "found": None if found is None else found.state_dict(),
            "sizes": [list(row) for row in self.sizes],
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.generation = int(state["generation"])
        self.sizes = [(int(row[0]), float(row[1]), float(row[2])) for row in state["sizes"]]
        if state["found"] is None:
            for mixture, own in zip(self.mixtures, state["mixtures"], strict=True):
                mixture.load_state_dict(own)
        else:
            self.found = self._mixture(int(state["groups"]))
            self.found.load_state_dict(state["found"])
        self.generator.set_state(state["generator"].cpu())
