"""The methods that POPL is compared with, from their configuration: pooled CPL, EM and VPL."""

import torch

from popl_rl.algorithms.em import EM
from popl_rl.algorithms.initialisation import cpl_training, initial_population
from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.vpl import VPL
from popl_rl.config import MethodConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.style_codes import StyleClone

__all__ = ["build_alternative"]


def build_alternative(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    clone: StyleClone | None = None,
    generator: torch.Generator,
) -> MultiCPL | EM | VPL:
    """Build what ``method.algorithm`` names, other than ``popl``.

    ``cpl`` is a single policy. ``em`` is as many mixtures of ``method.groups`` as there is room for
    among ``method.members``, at least one.

    Args:
        config: Which, and how it learns.
        spec: Sizes of the hypotheses.
        bank: Segments.
        comparisons: M strict preferences and the case of each.
        clone: What policies are style codes of; they are whole networks if None.
        generator: Source of all randomness.

    Raises:
        ValueError: If VPL is to learn reward functions, or style codes.
    """
    if config.algorithm == "vpl":
        if clone is not None:
            raise ValueError(
                "method.evolve must be all for method.algorithm=vpl, whose z takes the place of a "
                "style code, got 'code'"
            )
        return _build_vpl(config, spec, bank, comparisons, generator=generator)
    members = 1 if config.algorithm == "cpl" else config.members
    if config.algorithm == "em":
        members = max(1, members // config.groups) * config.groups
    population = initial_population(
        config, spec, members, clone=clone, device=bank.row.device, generator=generator
    )
    training = cpl_training(config, population, bank, comparisons, generator=generator)
    parts = (population, bank, comparisons)
    if config.algorithm == "em":
        return EM(*parts, groups=config.groups, training=training, generator=generator)
    return MultiCPL(*parts, training=training, generator=generator)


def _build_vpl(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    generator: torch.Generator,
) -> VPL:
    if not isinstance(spec, PolicySpec):
        raise ValueError(
            "method.algorithm=vpl learns policies, not reward functions; choose another method, or "
            "set method.learns=policy where there is something to do"
        )
    return VPL(
        spec,
        bank,
        comparisons,
        latent=config.latent,
        kl=config.kl,
        generations=config.generations,
        steps=config.steps,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        alpha=config.alpha,
        conservatism=config.conservatism,
        discount=config.discount,
        generator=generator,
    )
