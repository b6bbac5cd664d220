"""Behaviours that gather data: tables of action probabilities, and uniformly random actions."""

from collections.abc import Callable
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import INFO

__all__ = ["Behaviour", "random_behaviour", "table_behaviour"]


#: Maps a TensorDict ``[B]`` of current observations and a generator to actions.
Behaviour = Callable[[TensorDictBase, torch.Generator], Tensor]


def table_behaviour(probabilities: Tensor) -> Behaviour:
    """A behaviour from a table ``[S, A]`` of action probabilities, looked up by state index."""

    def act(step: TensorDictBase, generator: torch.Generator) -> Tensor:
        rows = probabilities[step[INFO, "next_state"].long()]
        return torch.multinomial(rows, 1, generator=generator).squeeze(-1)

    return act


def random_behaviour(action_space: gymnasium.Space[Any]) -> Behaviour:
    """Uniformly random actions of a ``Discrete`` or bounded ``Box`` space.

    Raises:
        TypeError: If the space is neither, or a ``Box`` without bounds.
    """
    if isinstance(action_space, gymnasium.spaces.Discrete):
        count = int(action_space.n)
        return lambda step, generator: torch.randint(count, step.batch_size, generator=generator)
    if isinstance(action_space, gymnasium.spaces.Box) and action_space.is_bounded():
        low, high = (torch.as_tensor(end).float() for end in (action_space.low, action_space.high))
        return lambda step, generator: (
            low + (high - low) * torch.rand(*step.batch_size, *low.shape, generator=generator)
        )
    raise TypeError(f"action_space must be Discrete or a bounded Box, got {action_space}")
