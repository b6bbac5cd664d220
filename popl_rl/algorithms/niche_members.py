"""Fresh members, one for each niche of a given division of the raters."""

from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.divisions import responsibility
from popl_rl.algorithms.niche_search import descend_served
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.stacked_adam import StackedAdam
from popl_rl.models.schedules import decay

__all__ = ["GIVEN", "NicheMembers", "train_niches"]

GIVEN = 0.25
"""Share of the generations in which a division that was found is kept as it is."""


class NicheMembers:
    """Members that are trained by the whole recipe, each on the raters of its niche.

    Args:
        problem: What is to be learnt, and the recipe.
        served: How much each niche serves each rater, ``[K, C]``, summing to 1 over K.
        generator: Source of initial weights and batches.

    Attributes:
        served: As given, until ``divide_anew``.
        share: Share of the raters that each niche serves, ``[K]``.
        stack: The K members.
        training: Their optimiser.
    """

    def __init__(self, problem: Problem, served: Tensor, *, generator: torch.Generator) -> None:
        self.problem, self.generator = problem, generator
        self.served, self.share = served, served.mean(1)
        self.stack = problem.initial_population(len(served), generator=generator)
        self.training = StackedAdam(self.stack, problem.training.learning_rate)

    def divide_anew(self) -> None:
        """E-step: members serve the raters whose answers they explain best."""
        self.served = responsibility(self.problem, self.stack, self.share)
        self.share = self.served.mean(1)

    def step(self, now: int, last: int, *, given: float = 1.0) -> float:
        """Run one generation: an E-step, once members know whom they serve, and gradient steps.

        Args:
            now: Number of the generation, from 0 on.
            last: Generations in all, over which the learning rate falls.
            given: Share of them in which the division is kept as it was given.

        Returns:
            The last gradient step's loss, averaged over members.
        """
        if now >= given * last:
            self.divide_anew()
        rate = self.problem.training.learning_rate * decay(now, last)
        self.training.optimizer.param_groups[0]["lr"] = rate
        return descend_served(self.problem, self.stack, self.training, self.served, self.generator)

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on, but the generator."""
        return {
            "members": self.stack.members.data.clone().to_dict(),
            "served": self.served.clone(),
            "share": self.share.clone(),
            "training": self.training.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.stack.members.data.update_(state["members"])
        self.served, self.share = state["served"].clone(), state["share"].clone()
        self.training.load_state_dict(state["training"])


def train_niches(
    problem: Problem,
    served: Tensor,
    *,
    generations: int,
    given: float = 1.0,
    generator: torch.Generator,
) -> NicheMembers:
    """Fresh members, trained from beginning to end.

    Args:
        problem: What is to be learnt, and the recipe.
        served: How much each niche serves each rater, ``[K, C]``, summing to 1 over K.
        generations: Generations of training, ``problem.block`` steps each.
        given: Share of them in which the division is kept as it was given.
        generator: Source of initial weights and batches.
    """
    members = NicheMembers(problem, served, generator=generator)
    for generation in range(generations):
        members.step(generation, generations, given=given)
    return members
