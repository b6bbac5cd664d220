"""A mixture of CPL hypotheses, one for each of K groups, by expectation maximisation.

The baseline that is told how many groups there are: the clustering of MaxMin-RLHF (Chakraborty et
al., 2024, arXiv 2402.08925), with CPL policies in the place of reward models and soft
responsibilities in the place of hard ones. On two doors hard ones were no better where raters are
known, and told two groups apart from preferences alone in none of eight starts, soft ones in two.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.draws import Draws, by_case
from popl_rl.algorithms.expectation import Expectation, expect
from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.problem import Problem
from popl_rl.config import EMSettings
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.preference_likelihood import per_case

__all__ = ["EM"]


class EM(MultiCPL):
    """Mixtures of K hypotheses from several random starts, of which the likeliest is the result.

    A case, that is a rater or a single preference, belongs to component k with chance
    ``share_k * prod p(answer)``, normalised over the components (E-step, once a generation), under
    the response model with slips; then every component takes CPL steps on comparisons drawn by
    these chances, and shares become their means (M-step). A start may end in a poor optimum, so
    several run side by side: as many mixtures as there is room for among ``problem.members``.

    Args:
        problem: What is to be learnt.
        em: Number K of components of a mixture.
        generator: Source of all randomness.

    Attributes:
        share: Shares of the components, ``[R, K]``.

    Raises:
        ValueError: If the number of groups is missing or below 1.
    """

    def __init__(self, problem: Problem, *, em: EMSettings, generator: torch.Generator) -> None:
        groups = em.groups
        if groups is None or groups < 1:
            raise ValueError(f"em.groups must be a number of at least 1, got {groups}")
        starts = max(1, problem.members // groups)
        population = problem.initial_population(starts * groups, generator=generator)
        super().__init__(problem, population=population, generator=generator)
        self.share = torch.full((starts, groups), 1 / groups, device=problem.device)

    def _draws(self, scores: Callable[[], Tensor]) -> tuple[Draws, dict[str, float]]:
        belongs, evidence = self._expect(scores())
        likelihood = evidence.mean(1)
        self.share = belongs.mean(2)
        about = {
            "log_likelihood": float(likelihood.max()),
            "smallest_share": float(self.share[likelihood.argmax()].min()),
        }
        return by_case(self.problem.comparisons, belongs.flatten(0, 1)), about

    def _expect(self, scores: Tensor) -> Expectation:
        """Responsibilities ``[R, K, C]`` and evidence ``[R, C]`` of every mixture."""
        likelihood = per_case(self.problem.likelihood(scores), self.problem.comparisons)
        return expect(likelihood.unflatten(0, self.share.shape), self.share)

    def likelihood(self) -> Tensor:
        """Mean log-likelihood of a case under each mixture as it is now, ``[R]``."""
        return self._expect(self.problem.compared_scores(self.population)).evidence.mean(1)

    def result(self) -> HypothesisSet:
        """The components of the likeliest mixture, their scale fitted for catering."""
        groups = self.share.shape[1]
        first = int(self.likelihood().argmax()) * groups
        everybody = self.problem.hypothesis_set(self.population)
        return self.problem.calibrated(everybody.subset(range(first, first + groups)))

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {**super().state_dict(), "share": self.share.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        super().load_state_dict(state)
        self.share = state["share"].clone()
