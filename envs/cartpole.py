"""Gymnasium's CartPole for people who want the cart at the left, or at the right.

The smallest continuous world: a pole is to be kept upright on a cart, and an episode ends where it
falls. Nobody is content with the middle.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import OBSERVATION
from popl_rl.registry import behaviour, rater

__all__ = ["balance", "left", "right", "to_the_left", "to_the_right"]

_PLACE = 1.0  # where people want the cart, left or right of the middle; the track ends at 2.4
_LEAN = 0.1  # the greatest angle at which a script lets the pole lean


@rater("left")
def left(segments: TensorDictBase) -> Tensor:
    """1 for a cart one unit left of the middle, less on both sides, 0 from one unit away on."""
    return _closeness(segments, -_PLACE)


@rater("right")
def right(segments: TensorDictBase) -> Tensor:
    """1 for a cart one unit right of the middle, less on both sides, 0 from one unit away on."""
    return _closeness(segments, _PLACE)


@behaviour("to_the_left")
def to_the_left(step: TensorDictBase, generator: torch.Generator) -> Tensor:  # noqa: ARG001
    """Balance, and drive to where ``left`` wants the cart."""
    return _drive(step, -_PLACE)


@behaviour("to_the_right")
def to_the_right(step: TensorDictBase, generator: torch.Generator) -> Tensor:  # noqa: ARG001
    """Balance, and drive to where ``right`` wants the cart."""
    return _drive(step, _PLACE)


@behaviour("balance")
def balance(step: TensorDictBase, generator: torch.Generator) -> Tensor:  # noqa: ARG001
    """Balance in the middle."""
    return _drive(step, 0.0)


def _fits(env: Any) -> str | None:
    """What speaks against these raters in an environment; left and right are words of many."""
    space = env.observation_space
    if space.shape == (4,):
        return None
    return (
        "it is of CartPole, and reads the place of the cart, the first of four numbers observed, "
        f"where {space} is observed; a function of yours is named as in my_raters.py:left"
    )


setattr(left, "fits", _fits)  # noqa: B010 - the type of a function has none
setattr(right, "fits", _fits)  # noqa: B010


def _closeness(segments: TensorDictBase, place: float) -> Tensor:
    cart: Tensor = segments[OBSERVATION][..., 0]
    return (1 - (cart - place).abs()).clamp(min=0)


def _drive(step: TensorDictBase, place: float) -> Tensor:
    """Lean towards a place and away from speed, and push to where the pole falls from there."""
    cart, speed, angle, turning = step[OBSERVATION].unbind(-1)
    lean = (0.1 * (place - cart) - 0.15 * speed).clamp(-_LEAN, _LEAN)
    push: Tensor = angle - lean + 0.3 * turning > 0
    return push.long()
