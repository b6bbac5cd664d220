"""Behaviours that gather data: tables of action probabilities, and uniformly random actions.

Data hold actions as the environment takes them: those of ``Discrete(3, start=1)`` are 1, 2 and 3.
Learners count them from 0.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import INFO

__all__ = ["Behaviour", "first_action", "random_behaviour", "table_behaviour"]


#: Maps a TensorDict ``[B]`` of current observations and a generator to actions, as the environment
#: takes them.
Behaviour = Callable[[TensorDictBase, torch.Generator], Tensor]


def first_action(action_space: gymnasium.Space[Any]) -> int:
    """The lowest action of a ``Discrete`` space, which learners know as 0; 0 for other spaces."""
    if isinstance(action_space, gymnasium.spaces.Discrete):
        return int(action_space.start)
    return 0


def table_behaviour(probabilities: Tensor, *, first: int = 0) -> Behaviour:
    """A behaviour from a table of action probabilities, looked up by state index.

    Args:
        probabilities: ``[S, A]``.
        first: The action of the first column, see ``first_action``.
    """

    def act(step: TensorDictBase, generator: torch.Generator) -> Tensor:
        rows = probabilities[step[INFO, "next_state"].long()]
        return first + torch.multinomial(rows, 1, generator=generator).squeeze(-1)

    return act


def random_behaviour(action_space: gymnasium.Space[Any], *, unbounded: bool = False) -> Behaviour:
    """Uniformly random actions of a ``Discrete`` or bounded ``Box`` space.

    Args:
        action_space: The space.
        unbounded: Whether a ``Box`` without bounds will do, of which standard normal actions are
            drawn.

    Raises:
        TypeError: If the space is neither, or a ``Box`` without bounds and ``unbounded`` is False.
    """
    if isinstance(action_space, gymnasium.spaces.Discrete):
        first, end = int(action_space.start), int(action_space.start + action_space.n)
        return lambda step, generator: torch.randint(
            first, end, step.batch_size, generator=generator
        )
    if isinstance(action_space, gymnasium.spaces.Box) and action_space.is_bounded():
        low, high = (torch.as_tensor(end).float() for end in (action_space.low, action_space.high))
        return lambda step, generator: (
            low + (high - low) * torch.rand(*step.batch_size, *low.shape, generator=generator)
        )
    if isinstance(action_space, gymnasium.spaces.Box) and unbounded:
        return lambda step, generator: torch.randn(
            *step.batch_size, *action_space.shape, generator=generator
        )
    raise TypeError(f"action_space must be Discrete or a bounded Box, got {action_space}")
