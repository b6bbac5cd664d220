"""Several CPL policies side by side, each trained on everybody's answers."""

from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.variation import GradientCPL
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.models.scoring import case_values, margins, rater_accuracy

__all__ = ["MultiCPL"]


class MultiCPL:
    """Pooled CPL (arXiv 2310.13639) from several initial weights: an ensemble without selection.

    What POPL's set has to beat by more than its size: policies that differ by chance alone. With a
    single member it is pooled CPL.

    Args:
        population: N policies with different initial weights, changed in place.
        bank: Segments that the comparisons refer to.
        comparisons: M strict preferences and the case of each.
        training: The loop that trains the policies, a block of CPL steps for each generation; its
            loss tells the scale and the discount of the scores.
        generator: Source of all randomness, the one that ``training`` draws from.

    Attributes:
        generation: Generations done so far.
        alpha: Scale of the scores.
        discount: Per-step discount of the scores.
    """

    def __init__(
        self,
        population: Population,
        bank: SegmentBank,
        comparisons: Comparisons,
        *,
        training: GradientCPL,
        generator: torch.Generator,
    ) -> None:
        self.population = population
        self.bank = bank
        self.comparisons = comparisons
        self.training = training
        self.alpha, self.discount = training.loss.alpha, training.loss.discount
        self.generator = generator
        self.generation = 0

    def step(self) -> dict[str, float]:
        """Run one generation: judge the policies, then train them.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over cases of the best member's
            accuracy) and ``mean_accuracy``, both as the generation found them, and ``loss_cpl``.
        """
        margin = margins(
            self.population, self.bank, self.comparisons, alpha=self.alpha, discount=self.discount
        )
        weight, about = self._weights(margin)
        # Everybody is the one child of itself.
        itself = torch.arange(len(self.population), device=margin.device)
        trained = self.training(itself, weight)
        self.generation += 1
        passes = margin > 0
        return {
            "worst_rater_accuracy": rater_accuracy(case_values(passes, self.comparisons)),
            "mean_accuracy": float(passes.float().mean()),
            **about,
            **trained,
        }

    def _weights(self, margin: Tensor) -> tuple[Tensor, dict[str, float]]:
        """How often each policy draws each comparison, ``[N, M]``, and scalars to log."""
        return torch.ones_like(margin), {}

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "members": self.population.members.data.clone().to_dict(),
            "training": self.training.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`, bit for bit."""
        self.generation = int(state["generation"])
        self.population.members.data.update_(state["members"])
        self.training.load_state_dict(state["training"])
        self.generator.set_state(state["generator"].cpu())
