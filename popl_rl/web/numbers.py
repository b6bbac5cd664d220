"""What each policy does, in a few numbers that can be told without knowing any group."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor

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
    make_env: Callable[[], gymnasium.Env[Any, Any]],
    *,
    success: str,
    door: str | None = None,
    measured: Sequence[str] = (),
    episodes: int,
    max_steps: int,
    seed: int,
) -> list[Number]:
    """Roll every policy and measure what its environment says can be measured.

    Args:
        policies: N policies.
        everybody: A single one, the one for everybody.
        make_env: Builds an environment to act in.
        success: Number in ``info`` that is positive when the task is done.
        door: Integer in ``info`` whose values are worth a rate; None for none.
        measured: Numbers in ``info`` whose mean and peak are shown.
        episodes: Of each policy.
        max_steps: Steps after which an episode is cut.
        seed: Of starts and actions.
    """
    own, other = (
        _measures(
            roll_out(make_env, some, episodes=episodes, max_steps=max_steps, seed=seed),
            success=success,
            door=door,
            measured=measured,
        )
        for some in (policies, everybody)
    )
    nothing = torch.zeros(1)  # a door that nobody uses has no rate
    return [
        Number(phrase, values, float(other.get((phrase, about), nothing)[0]), dict(about))
        for (phrase, about), values in own.items()
    ]


def _measures(
    rolled: TensorDictBase, *, success: str, door: str | None, measured: Sequence[str]
) -> dict[tuple[str, tuple[tuple[str, Any], ...]], Tensor]:
    """Values ``[N]`` of episodes ``[N, E, H]`` by phrase and what it is filled with."""
    found: dict[tuple[str, tuple[tuple[str, Any], ...]], Tensor] = {}
    done = success_rate(rolled, success)
    if bool(done.isfinite().all()):
        found["m_success", ()] = done
        found["m_steps", ()] = steps_to_success(rolled, success)
    if door is not None:
        for value, rate in info_rates(rolled, door).items():
            if value >= 0:
                found["m_rate", (("name", door), ("value", value))] = rate
    for name in measured:
        mean, peak = mean_and_peak(rolled, name)
        found["m_mean", (("name", name),)] = mean
        found["m_peak", (("name", name),)] = peak
    reward = (rolled[REWARD] * rolled[MASK]).sum(-1).mean(-1)
    if bool((reward != 0).any()):
        found["m_return", ()] = reward
    return found
