"""What methods start from, from their configuration: a population, and how it descends CPL."""

from typing import Literal, cast

import torch

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.variation import GradientCPL
from popl_rl.config import MethodConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.style_codes import StyleClone
from popl_rl.models.style_population import StyledPopulation

__all__ = ["conservatism_of", "cpl_training", "initial_population"]


def conservatism_of(config: MethodConfig, spec: PolicySpec | RewardSpec) -> float:
    """It keeps policies near the data; of reward functions only differences matter."""
    return config.conservatism if isinstance(spec, PolicySpec) else 1.0


def initial_population(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    count: int,
    *,
    clone: StyleClone | None,
    device: torch.device,
    generator: torch.Generator,
) -> Population:
    """Fresh members: networks or heads, or codes of the data if there is a clone.

    Args:
        config: What a member is.
        spec: Sizes of the hypotheses.
        count: Number of members.
        clone: What members are style codes of; they are networks if None.
        device: Where the members are to be.
        generator: Source of initial weights, or of the codes.
    """
    if clone is not None:
        return StyledPopulation(clone, clone.draw(count, generator=generator))
    evolve = cast("Literal['all', 'head']", config.evolve)
    return Population.create(spec, count, evolve=evolve, generator=generator).to(device)


def cpl_training(
    config: MethodConfig,
    population: Population,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    generator: torch.Generator,
) -> GradientCPL:
    """The loop that descends the members' CPL losses as configured.

    Args:
        config: How they learn.
        population: The members, trained in place.
        bank: Segments.
        comparisons: M strict preferences.
        generator: Source of batches.
    """
    loss = CPLLoss(
        population,
        bank,
        alpha=config.alpha,
        conservatism=conservatism_of(config, cast("PolicySpec | RewardSpec", population.spec)),
        discount=config.discount,
    )
    return GradientCPL(
        loss,
        comparisons,
        generations=config.generations,
        learning_rate=config.learning_rate,
        steps=config.steps,
        batch_size=config.batch_size,
        generator=generator,
    )
