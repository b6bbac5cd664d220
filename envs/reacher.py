"""MuJoCo's Reacher, through Gymnasium, for people who want it quick and people who want it smooth.

An arm of two links is to bring its tip to a place that is drawn anew for each episode.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import INFO, OBSERVATION
from popl_rl.registry import behaviour

__all__ = ["quick", "reach_gently", "reach_hard", "smooth", "wander"]

_EFFORT = 3.0  # what a squared torque is worth to people who want it smooth, in metres
_LENGTHS = (0.1, 0.11)  # of the two links, in metres


def quick(segments: TensorDictBase) -> Tensor:
    """Distance from the place, in metres, as a cost: be there soon."""
    distance: Tensor = segments[INFO, "reward_dist"]
    return distance.float()


def smooth(segments: TensorDictBase) -> Tensor:
    """Distance likewise, and effort, the sum of squared torques: be there without haste."""
    effort: Tensor = segments[INFO, "reward_ctrl"]
    return quick(segments) + _EFFORT * effort.float()


@behaviour("reach_hard")
def reach_hard(step: TensorDictBase, generator: torch.Generator) -> Tensor:  # noqa: ARG001
    """Pull the tip to the place with a strong spring."""
    return _pull(step, 40.0, 0.05)


@behaviour("reach_gently")
def reach_gently(step: TensorDictBase, generator: torch.Generator) -> Tensor:  # noqa: ARG001
    """Pull the tip to the place with a weak spring."""
    return _pull(step, 12.0, 0.06)


@behaviour("wander")
def wander(step: TensorDictBase, generator: torch.Generator) -> Tensor:
    """Torques that have nothing to do with the place."""
    return 0.3 * torch.randn(len(step), 2, generator=generator)


def _pull(step: TensorDictBase, stiffness: float, damping: float) -> Tensor:
    """Torques of a spring between tip and place, of some newtons per metre, and of dampers."""
    seen = step[OBSERVATION]
    cos, sin = seen[:, :2], seen[:, 2:4]
    speed, gap = seen[:, 6:8], -seen[:, 8:10]
    # Sine and cosine of the second link's direction, which is the sum of both angles.
    outer_sin = sin[:, 0] * cos[:, 1] + cos[:, 0] * sin[:, 1]
    outer_cos = cos[:, 0] * cos[:, 1] - sin[:, 0] * sin[:, 1]
    inner, outer = _LENGTHS
    second = outer * torch.stack([-outer_sin, outer_cos], -1)
    first = second + inner * torch.stack([-sin[:, 0], cos[:, 0]], -1)
    pull = torch.stack([(first * gap).sum(-1), (second * gap).sum(-1)], -1)
    torque: Tensor = (stiffness * pull - damping * speed).clamp(-1, 1)
    return torque
