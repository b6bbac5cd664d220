"""The two-dimensional stateless problem, and the rater who lives in it."""

from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.envs.hidden_utility import HiddenUtility
from popl_rl.keys import INFO, OBSERVATION
from popl_rl.registry import env, rater

__all__ = ["hidden_plane", "plane"]


@env("hidden_plane")
def hidden_plane(
    *, max_steps: int = 1000, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    """Make a ``popl_rl.envs.hidden_utility.HiddenUtility`` of states (x, y)."""
    made: gymnasium.Env[Any, Any]
    made = HiddenUtility(dimensions=2, max_steps=max_steps, render_mode=render_mode)
    return made


@rater("plane")
def plane(segments: TensorDictBase) -> Tensor:
    """Want y / (1 - xy) with chance 1 - xy, and else 0, by a coin thrown with each state.

    On average that is y, but comparisons are not decided by averages (the problem of arXiv
    2312.08358). At x = y = 1 it is 0.

    Raises:
        ValueError: If states do not have two coordinates.
    """
    states: Tensor = segments[OBSERVATION]
    if states.shape[-1] != 2:
        raise ValueError(
            f"rater 'plane' judges states of 2 coordinates, got {states.shape[-1]}; take "
            "env=hidden_plane, or env.options.dimensions=2."
        )
    x, y = states.unbind(-1)
    chance = 1 - x * y
    return torch.where(segments[INFO, "coin"] < chance, y / chance, 0.0)
