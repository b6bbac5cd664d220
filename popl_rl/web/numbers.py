"""What each policy does, in a few numbers that can be told without knowing any group."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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
    """One number of every policy.

    Attributes:
        phrase: Name of what it is, in the translations.
        values: Of N policies, ``[N]``.
        about: What the phrase is filled with.
    """

    phrase: str
    values: Tensor
    about: Mapping[str, Any] = field(default_factory=dict)


def policy_numbers(
    policies: PolicySet, world: World, env: EnvConfig, *, episodes: int, seed: int
) -> list[Number]:
    """Roll every policy and measure what its environment says can be measured.

    Args:
        policies: N policies.
        world: Where they act.
        env: What is success, a door, or worth measuring.
        episodes: Of each policy.
        seed: Of starts and actions.
    """
    rolled = roll_out(world.make, policies, episodes=episodes, max_steps=env.max_steps, seed=seed)
    numbers = []
    success = success_rate(rolled, env.success)
    if bool(success.isfinite().all()):
        numbers.append(Number("m_success", success))
        numbers.append(Number("m_steps", steps_to_success(rolled, env.success)))
    if env.door is not None:
        for value, rate in info_rates(rolled, env.door).items():
            if value >= 0:
                numbers.append(Number("m_rate", rate, {"name": env.door, "value": value}))
    for name in env.measured:
        mean, peak = mean_and_peak(rolled, name)
        numbers.append(Number("m_mean", mean, {"name": name}))
        numbers.append(Number("m_peak", peak, {"name": name}))
    reward = (rolled[REWARD] * rolled[MASK]).sum(-1).mean(-1)
    if bool((reward != 0).any()):
        numbers.append(Number("m_return", reward))
    return numbers
