"""Adam for a stack of members that may grow and shrink."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from popl_rl.models.population import Population
from popl_rl.optim import adam

__all__ = ["StackedAdam"]


class StackedAdam:
    """Adam over the members of a population, whose moments go where the members go.

    Args:
        population: What is optimised.
        learning_rate: Step size.

    Attributes:
        optimizer: The optimiser itself.
    """

    def __init__(self, population: Population, learning_rate: float) -> None:
        self.learning_rate = learning_rate
        self.optimizer = adam(population.members.parameters(), lr=learning_rate)

    def moved_to(self, population: Population, source: Sequence[int] | Tensor) -> "StackedAdam":
        """The optimiser of another population, made of present members and of new ones.

        The first moments of new members are 0 and their second moments the mean of all others', so
        that their first steps are neither giant nor tiny.

        Args:
            population: The other population.
            source: Present member that each of its members is; new ones have numbers beyond.
        """
        moved = StackedAdam(population, self.learning_rate)
        place = torch.as_tensor(source)
        old = self.optimizer.param_groups[0]["params"]
        new = moved.optimizer.param_groups[0]["params"]
        for before, after in zip(old, new, strict=True):
            state = self.optimizer.state.get(before)
            if not state:
                continue
            first, second = state["exp_avg"], state["exp_avg_sq"]
            row = place.clamp(max=len(first))
            first = torch.cat([first, torch.zeros_like(first[:1])])
            second = torch.cat([second, second.mean(0, keepdim=True)])
            moved.optimizer.state[after] = {
                "step": state["step"].clone(),
                "exp_avg": first[row],
                "exp_avg_sq": second[row],
            }
        return moved

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and its step size."""
        return copy.deepcopy(self.optimizer.state_dict())  # Adam changes its own in place

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore Adam's moments and its step size."""
        self.optimizer.load_state_dict(copy.deepcopy(state))
