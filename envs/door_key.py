"""Minigrid's locked door, for people who want it closed behind them and people who do not."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

import gymnasium
from minigrid.core.world_object import Door
from minigrid.envs.doorkey import DoorKeyEnv
from minigrid.minigrid_env import MiniGridEnv
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.envs.listed_minigrid import ListedMinigrid, MinigridListing
from popl_rl.keys import INFO
from popl_rl.registry import env, rater

__all__ = ["door_key", "quick", "thorough"]

_ACTIONS = (0, 1, 2, 3, 5)  # left, right, forward, pick up, toggle; the key cannot be dropped


@env("door_key")
def door_key(
    *,
    size: int = 6,
    layouts: int = 3,
    view: Literal["full", "partial"] = "full",
    start: Literal["own", "anywhere", "mixed"] = "own",
    max_steps: int = 60,
    render_mode: str | None = None,
) -> gymnasium.Env[Any, Any]:
    """Make Minigrid's ``DoorKey``: fetch the key, open the door, walk to the goal.

    Actions: 0 turn left, 1 turn right, 2 forward, 3 pick up, 4 toggle, which opens and closes a
    door. ``info`` holds ``door_open`` and ``goal``; see ``ListedMinigrid`` for the rest.

    Args:
        size: Cells along each side, outer walls included; at least 5.
        layouts: Number of layouts: Minigrid's for the seeds from 0 on.
        view: As of ``ListedMinigrid``.
        start: As of ``ListedMinigrid``.
        max_steps: Steps after which an episode is truncated.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: If an argument is out of its range.
    """
    if size < 5:
        raise ValueError(f"size must be at least 5, got {size}.")
    if layouts < 1:
        raise ValueError(f"layouts must be at least 1, got {layouts}.")
    made: gymnasium.Env[Any, Any] = ListedMinigrid(
        _listing(size, layouts),
        raters={"quick": quick, "thorough": thorough},
        view=view,
        start=start,
        max_steps=max_steps,
        render_mode=render_mode,
    )
    return made


@cache
def _listing(size: int, layouts: int) -> MinigridListing:
    simulator = DoorKeyEnv(size=size, max_steps=10**6)
    return MinigridListing(simulator, seeds=range(layouts), numbers=_numbers, actions=_ACTIONS)


@rater("quick")
def quick(segments: TensorDictBase) -> Tensor:
    """Want the goal soon and the door left open for whoever follows."""
    goal: Tensor = segments[INFO, "goal"]
    is_open: Tensor = segments[INFO, "door_open"]
    return goal.float() * (2.0 * is_open.float() - 1.0) - 0.05


@rater("thorough")
def thorough(segments: TensorDictBase) -> Tensor:
    """Want the goal, and the door closed behind one, though that takes longer."""
    goal: Tensor = segments[INFO, "goal"]
    is_open: Tensor = segments[INFO, "door_open"]
    return goal.float() * (1.0 - 2.0 * is_open.float()) - 0.02


def _numbers(simulator: MiniGridEnv) -> Mapping[str, float]:
    doors = [thing for thing in simulator.grid.grid if isinstance(thing, Door)]
    return {"door_open": int(all(door.is_open for door in doors))}


if "popl_rl/DoorKey-v0" not in gymnasium.registry:
    gymnasium.register("popl_rl/DoorKey-v0", entry_point="popl_rl.envs.door_key:door_key")
