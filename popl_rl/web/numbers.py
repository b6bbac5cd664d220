"""What each policy does, in a few numbers that can be told without knowing any group."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from popl_rl.config import EnvConfig
from popl_rl.data.environments import World
from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.measures import (
    info_rates,
    mean_and_peak,
    roll_out,
    steps_to_success,
    success_rate,
)
from popl_rl.keys import REWARD
from popl_rl.models.policy_set import PolicySet

__all__ = ["Number", "policy_numbers"]


@dataclass(frozen=True)
class Number:
    """One number of every policy of a set, and of the one for everybody.

    Attributes:
        phrase: Name of what it is, in the translations.
        values: Of N policies, ``[N]``.
        everybody: Of the policy for everybody.
        about: What the phrase is filled with.
    """

    phrase: str
    values: Tensor
    everybody: float
    about: Mapping[str, Any] = field(default_factory=dict)


def policy_numbers(
    policies: PolicySet,
    everybody: PolicySet,
    world: World,
    env: EnvConfig,
    *,
    episodes: int,
    seed: int,
) -> list[Number]:
    """Roll every policy and measure what its environment says can be measured.

    Args:
        policies: N policies.
        everybody: A single one, the one for everybody.
        world: Where they act.
        env: What is success, a door, or worth measuring.
        episodes: Of each policy.
        seed: Of starts and actions.
    """
    own, other = (
        _measures(some, world, env, episodes=episodes, seed=seed) for some in (policies, everybody)
    )
    nothing = torch.zeros(1)  # a door that nobody uses has no rate
    return [
        Number(phrase, values, float(other.get((phrase, about), nothing)[0]), dict(about))
        for (phrase, about), values in own.items()
    ]


def _measures(
    policies: PolicySet, world: World, env: EnvConfig, *, episodes: int, seed: int
) -> dict[tuple[str, tuple[tuple[str, Any], ...]], Tensor]:
    """Values ``[N]`` by phrase and what it is filled with."""
    rolled = roll_out(world.make, policies, episodes=episodes, max_steps=env.max_steps, seed=seed)
    found: dict[tuple[str, tuple[tuple[str, Any], ...]], Tensor] = {}
    success = success_rate(rolled, env.success)
    if bool(success.isfinite().all()):
        found["m_success", ()] = success
        found["m_steps", ()] = steps_to_success(rolled, env.success)
    if env.door is not None:
        for value, rate in info_rates(rolled, env.door).items():
            if value >= 0:
                found["m_rate", (("name", env.door), ("value", value))] = rate
    for name in env.measured:
        mean, peak = mean_and_peak(rolled, name)
        found["m_mean", (("name", name),)] = mean
        found["m_peak", (("name", name),)] = peak
    reward = (rolled[REWARD] * rolled[MASK]).sum(-1).mean(-1)
    if bool((reward != 0).any()):
        found["m_return", ()] = reward
    return found
