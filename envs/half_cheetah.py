"""MuJoCo's HalfCheetah, through Gymnasium, for people who want speed and people who save effort.

Half an animal that runs on two legs; no episode ends before its time.
"""

from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import INFO

__all__ = ["fast", "saving"]

# What a squared torque, between -1 and 1, costs people who save, in metres per second. Gymnasium's
# own reward says -0.1 for it.
_EFFORT = 2.0


def fast(segments: TensorDictBase) -> Tensor:
    """Speed ahead, in metres per second: run."""
    speed: Tensor = segments[INFO, "x_velocity"]
    return speed.float()


def saving(segments: TensorDictBase) -> Tensor:
    """Speed likewise, less effort, the sum of squared torques: get ahead with little."""
    effort: Tensor = segments[INFO, "reward_ctrl"]
    return fast(segments) + 10 * _EFFORT * effort.float()
