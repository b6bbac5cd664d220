"""Metaworld's robot arm at any of its fifty tasks, and people who want it quick or careful.

Metaworld (Yu et al., 2019, arXiv 1910.10897; McLean et al., 2025, arXiv 2505.11289), version 3.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.envs._metaworld_task import SPEEDS, STEP_SECONDS, MetaworldTask, TaskState
from popl_rl.keys import INFO
from popl_rl.registry import env, rater

__all__ = [
    "STEP_SECONDS",
    "MetaworldTask",
    "TaskState",
    "brisk_but_careful",
    "fast",
    "gentle",
    "metaworld",
]


@env("metaworld")
def metaworld(
    task: str = "drawer-open",
    *,
    max_steps: int = 300,
    terminate: bool = True,
    speeds: Sequence[float] = SPEEDS,
    render_mode: str | None = None,
    size: int = 240,
    camera: str = "corner2",
) -> gymnasium.Env[Any, Any]:
    """Make a ``MetaworldTask``, whose arguments these are."""
    made: gymnasium.Env[Any, Any] = MetaworldTask(
        task,
        max_steps=max_steps,
        terminate=terminate,
        speeds=speeds,
        render_mode=render_mode,
        size=size,
        camera=camera,
    )
    return made


# Utilities are in seconds. Waiting costs what it takes, until the task is done, and each metre that
# hand and object come nearer to done saves the time it takes at the speed a group has in mind: over
# an episode that does the task it adds up to the same whatever the way, but in a short clip it
# credits what was begun.


@rater("fast")
def fast(segments: TensorDictBase) -> Tensor:
    """Want the task done soon, however the arm moves: 1 s per second, metres at 1 m/s."""
    return _progress(segments, speed=1.0)


@rater("gentle")
def gentle(segments: TensorDictBase) -> Tensor:
    """Want the task done at no more than 0.2 m/s, without jerks or hard contact.

    As much again as waiting costs a hand of 0.4 m/s, or accelerating by 5 m/s²; each 200 J of
    work against contact forces costs 1 s.
    """
    return _progress(segments, speed=0.2) - _strain(segments, speed=0.2)


@rater("brisk_but_careful")
def brisk_but_careful(segments: TensorDictBase) -> Tensor:
    """Want the task done at about 0.4 m/s: as ``gentle``, with twice the speed and acceleration."""
    return _progress(segments, speed=0.4) - _strain(segments, speed=0.4)


def _progress(segments: TensorDictBase, *, speed: float) -> Tensor:
    info = segments[INFO]
    waiting = STEP_SECONDS * (1 - info["success"].float())
    progress: Tensor = info["closed"] / speed - waiting
    return progress


def _strain(segments: TensorDictBase, *, speed: float) -> Tensor:
    info = segments[INFO]
    excess = (info["hand_speed"] / speed - 1).clamp(min=0)
    jolt = info["hand_acceleration"] / (25 * speed)
    work = info["contact_force"] * info["hand_speed"] * STEP_SECONDS
    strain: Tensor = STEP_SECONDS * (excess.square() + jolt.square()) + work / 200
    return strain
