"""MuJoCo's Hopper, through Gymnasium, for people who want it fast and people who want it upright.

A leg that hops; an episode ends when it falls.
"""

from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import INFO

__all__ = ["fast", "upright"]


def fast(segments: TensorDictBase) -> Tensor:
    """One for each step on its foot, and speed ahead in metres per second: hop away."""
    return _healthy(segments) + _speed(segments)


def upright(segments: TensorDictBase) -> Tensor:
    """One for each step on its foot, less the speed either way: stand where one is."""
    return _healthy(segments) - _speed(segments).abs()


def _healthy(segments: TensorDictBase) -> Tensor:
    """1 where it has not fallen, ``[B, T]``."""
    healthy: Tensor = segments[INFO, "reward_survive"]
    return healthy.float()


def _speed(segments: TensorDictBase) -> Tensor:
    """Metres per second ahead, ``[B, T]``."""
    speed: Tensor = segments[INFO, "x_velocity"]
    return speed.float()
