"""Several CPL hypotheses side by side, each trained on comparisons that it draws by its weights."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.draws import Draws, by_case
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.variation import GradientCPL
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.scoring import pass_shares, rater_accuracy

__all__ = ["MultiCPL"]


class MultiCPL:
    """CPL (arXiv 2310.13639) from several initial weights: an ensemble without selection.

    What POPL's set has to beat by more than its size: hypotheses that differ by chance alone. With
    a single member it is pooled CPL. Of reward functions this is Bradley–Terry reward learning as
    in RLHF (Christiano et al., 2017).

    Args:
        problem: What is to be learnt.
        population: Members to start from, changed in place; ``problem.members`` fresh ones if None.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.
        population: The hypotheses as they are now.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        population: Population | None = None,
        generator: torch.Generator,
    ) -> None:
        if population is None:
            population = problem.initial_population(problem.members, generator=generator)
        self.problem = problem
        self.population = population
        self.training = GradientCPL.of(problem, population, generator=generator)
        self.generator = generator
        self.generation = 0
        self.generations = problem.generations

    def step(self) -> dict[str, float]:
        """Run one generation: evaluate the hypotheses, then train them.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over cases of the best member's
            accuracy) and ``mean_accuracy``, both as the generation found them, and ``loss_cpl``.
        """
        scores = self.problem.compared_scores(self.population)
        passed = pass_shares(scores, self.problem.comparisons)
        draws, about = self._draws(lambda: scores)
        return {
            "worst_rater_accuracy": rater_accuracy(passed.values),
            "mean_accuracy": passed.mean,
            **about,
            **self._train(draws),
        }

    def step_unwatched(self) -> None:
        """Run one generation of which nobody wants to know how it goes.

        Hypotheses end as after ``step``. To score them takes longer than to train a few.
        """
        draws, _ = self._draws(lambda: self.problem.compared_scores(self.population))
        self._train(draws)

    def _train(self, draws: Draws) -> dict[str, float]:
        # Everybody is the one child of itself.
        itself = torch.arange(len(self.population), device=self.problem.device)
        trained = self.training.descend(itself, draws)
        self.generation += 1
        return trained

    def _draws(self, scores: Callable[[], Tensor]) -> tuple[Draws, dict[str, float]]:  # noqa: ARG002
        """How often each member draws each comparison, and scalars to log; scores if asked for."""
        comparisons = self.problem.comparisons
        weight = torch.ones(len(self.population), comparisons.num_cases, device=self.problem.device)
        return by_case(comparisons, weight), {}

    def result(self) -> HypothesisSet:
        """One member for each distinct behaviour, its scale fitted for catering."""
        return self.problem.calibrated(self.problem.distinct(self.population))

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "members": self.population.members.data.clone().to_dict(),
            "training": self.training.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.generation = int(state["generation"])
        self.population.members.data.update_(state["members"])
        self.training.load_state_dict(state["training"])
        self.generator.set_state(state["generator"].cpu())
