"""How children differ from their parents: Gaussian mutation of a head, or CPL gradient steps."""

import copy
from typing import Any, Protocol

import torch
from torch import Tensor

from popl_rl.algorithms.draws import Draws, by_case
from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.algorithms.problem import Problem
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.models.schedules import linear_decay
from popl_rl.optim import adam

__all__ = ["GaussianHead", "GradientCPL", "Variation", "inherit_moments"]


def inherit_moments(optimizer: torch.optim.Optimizer, parents: Tensor) -> None:
    """Give every child of a stacked population its parent's Adam moments."""
    for state in optimizer.state.values():
        for moment in ("exp_avg", "exp_avg_sq"):
            state[moment] = state[moment][parents]


class Variation(Protocol):
    """Turns selected parents into the next generation, in place."""

    def __call__(self, parents: Tensor, strength: Tensor) -> dict[str, float]:
        """Replace the population by varied copies of ``parents``.

        Args:
            parents: Member that each child copies, ``[N]``.
            strength: How much each child should learn from each case, ``[N, C]``.

        Returns:
            Scalars to log.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """State to checkpoint."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        ...


class GaussianHead:
    """The operator of the POPL authors' public code.

    Each child is its parent's head, flattened and of unit norm, with N(0, std) added to one
    coordinate chosen uniformly, and renormalised.

    Args:
        population: A population whose members are linear heads (``evolve="head"``).
        std: Standard deviation of the mutation.
        generator: Source of randomness.

    Raises:
        ValueError: If the population evolves more than a head, or ``std`` is not positive.
    """

    def __init__(
        self, population: Population, *, std: float = 0.1, generator: torch.Generator
    ) -> None:
        if population.evolve != "head":
            raise ValueError(
                f"population must have evolve='head' for Gaussian mutation, got "
                f"{population.evolve!r}; set method.evolve=head"
            )
        if not std > 0:
            raise ValueError(f"std must be positive, got {std}")
        self.population = population
        self.std = std
        self.generator = generator
        self._normalise()

    def _flat(self) -> Tensor:
        members = self.population.members.data
        return torch.cat([value.flatten(1) for value in members.values(True, True)], 1)

    def _write(self, flat: Tensor) -> None:
        members, start = self.population.members.data, 0
        for value in members.values(True, True):
            stop = start + value[0].numel()
            value.copy_(flat[:, start:stop].view_as(value))
            start = stop

    def _normalise(self) -> None:
        flat = self._flat()
        self._write(flat / flat.norm(dim=1, keepdim=True))

    def __call__(self, parents: Tensor, strength: Tensor) -> dict[str, float]:  # noqa: ARG002
        """See ``Variation``; ``strength`` is not used."""
        self.population.replace_(parents)
        flat = self._flat()
        shape, source, device = (len(flat), 1), self.generator, flat.device
        coordinate = torch.randint(flat.shape[1], shape, generator=source, device=device)
        noise = self.std * torch.randn(shape, generator=source, device=device)
        self._write(flat.scatter_add(1, coordinate, noise))
        self._normalise()
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Nothing beyond the population and the generator."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


class GradientCPL:
    """Gradient lexicase for CPL: a child descends CPL where its parent is strong.

    After gradient lexicase (Ding and Spector, ICLR 2022), with competition: strength is measured
    against the rest of the population, so that members part company instead of memorising
    whatever they already pass. Children inherit their parent's Adam moments.

    Args:
        loss: CPL loss of the population.
        comparisons: Training preferences.
        generations: Generations to come; Adam's step size is held for half of them, then falls
            linearly to zero.
        learning_rate: Adam's step size.
        steps: Gradient steps per generation.
        batch_size: Preferences per member and step.
        generator: Source of batches.
    """

    def __init__(
        self,
        loss: CPLLoss,
        comparisons: Comparisons,
        *,
        generations: int,
        learning_rate: float = 2e-3,
        steps: int = 10,
        batch_size: int = 128,
        generator: torch.Generator,
    ) -> None:
        self.loss = loss
        self.comparisons = comparisons
        self.steps = steps
        self.batch_size = batch_size
        self.generator = generator
        self.optimizer = adam(loss.population.members.parameters(), lr=learning_rate)
        self.schedule = linear_decay(self.optimizer, generations)

    @classmethod
    def of(
        cls, problem: Problem, population: Population, *, generator: torch.Generator
    ) -> "GradientCPL":
        """The loop that descends a population's CPL losses by the recipe of a problem."""
        return cls(
            problem.loss(population),
            problem.comparisons,
            generations=problem.generations,
            learning_rate=problem.training.learning_rate,
            steps=problem.block,
            batch_size=problem.training.batch_size,
            generator=generator,
        )

    def __call__(self, parents: Tensor, strength: Tensor) -> dict[str, float]:
        """See ``Variation``."""
        return self.descend(parents, by_case(self.comparisons, strength))

    def descend(self, parents: Tensor, draws: Draws) -> dict[str, float]:
        """Replace the population by copies of ``parents`` that learn from what they draw.

        Args:
            parents: Member that each child copies, ``[N]``.
            draws: How often each child draws each comparison.

        Returns:
            Scalars to log.
        """
        self.loss.population.replace_(parents)
        inherit_moments(self.optimizer, parents)
        value = descend(
            self.loss,
            self.optimizer,
            self.comparisons,
            steps=self.steps,
            batch_size=self.batch_size,
            draws=draws,
            generator=self.generator,
        )
        self.schedule.step()
        return {"loss_cpl": value}

    def warm_up(self, steps: int) -> None:
        """Descend the pooled CPL loss, before any selection."""
        descend(
            self.loss,
            self.optimizer,
            self.comparisons,
            steps=steps,
            batch_size=self.batch_size,
            generator=self.generator,
        )

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and the learning rate."""
        # A scheduler's own state holds its lambda; how far it is, is all it needs.
        state = copy.deepcopy(self.optimizer.state_dict())  # Adam changes its own in place
        return {"optimizer": state, "epoch": self.schedule.last_epoch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore Adam's moments and the learning rate."""
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.schedule.last_epoch = int(state["epoch"])
