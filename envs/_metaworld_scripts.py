"""Metaworld's scripted policies as behaviours: at a chosen speed, noisy, and pushed about."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from metaworld.policies import ENV_POLICY_MAP
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.envs._metaworld_simulator import Array, task_name
from popl_rl.keys import OBSERVATION

__all__ = ["ANCHOR_SPEED", "Scripted", "script"]

#: An action of 1 moves the hand's anchor by 1 cm in 12.5 ms, in m/s.
ANCHOR_SPEED = 0.8
_PUSH_STEPS = 10


class Scripted:
    """The task's scripted policy, with its hand's speed limited.

    Each axis is limited by itself, as the script itself is clipped, so that the hand takes the same
    way at every speed. Along a diagonal it is up to 1.7 times as fast.

    Args:
        task: Name of the task.
        speed: Greatest commanded speed along each axis, in m/s; no more than 0.8 can be commanded.
        noise: Standard deviation of white noise on each axis, relative to ``speed``.
        push: Chance per step that a push begins: 10 steps of ``speed`` in a random direction.

    Raises:
        ValueError: If there is no such task, ``speed`` is not positive, ``noise`` is negative or
            ``push`` no probability.
    """

    def __init__(
        self, task: str, *, speed: float = ANCHOR_SPEED, noise: float = 0.0, push: float = 0.0
    ) -> None:
        if not speed > 0:
            raise ValueError(f"speed must be positive, in m/s, got {speed}.")
        if not noise >= 0:
            raise ValueError(f"noise must be at least 0, got {noise}.")
        if not 0 <= push <= 1:
            raise ValueError(f"push must be a probability in [0, 1], got {push}.")
        self.speed, self.noise, self.push = speed, noise, push
        self._script = script(task)
        self._limit = min(speed / ANCHOR_SPEED, 1.0)
        self.reset()

    def reset(self) -> None:
        """Forget pushes under way: a batch of new episodes begins."""
        self._direction = torch.zeros(0, 3)
        self._left = torch.zeros(0)

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        """Return the actions ``[B, 4]`` of a batch."""
        return self.act(step[OBSERVATION].numpy(), generator)

    def act(self, observation: NDArray[np.float32], generator: torch.Generator) -> Tensor:
        """Return the actions ``[B, 4]`` at observations ``[B, O]``."""
        asked = np.stack([self._script(row.astype(np.float64)) for row in observation])
        action = torch.from_numpy(asked).float().clamp(-1, 1)
        move = action[:, :3].clamp(-self._limit, self._limit)
        noise, chance, direction = self._draw(move.shape, generator)
        if self.noise:
            move += self._limit * self.noise * noise
        if self.push:
            move = self._pushed(move, chance, direction)
        action[:, :3] = move.clamp(-1, 1)
        return action

    def skip(self, steps: int, generator: torch.Generator) -> None:
        """Draw what as many steps of one episode would draw, so that others can take them."""
        for _ in range(steps):
            self._draw(torch.Size([1, 3]), generator)

    def _draw(self, shape: torch.Size, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Noise, chances of pushes and their directions; empty where there are none."""
        noise = chance = direction = torch.empty(0)
        if self.noise:
            noise = torch.randn(shape, generator=generator)
        if self.push:
            chance = torch.rand(shape[0], generator=generator)
            direction = torch.randn(shape, generator=generator)
        return noise, chance, direction

    def _pushed(self, move: Tensor, chance: Tensor, drawn: Tensor) -> Tensor:
        if len(self._left) != len(move):
            self._direction, self._left = torch.zeros_like(move), torch.zeros(len(move))
        begins = chance < self.push
        begins &= self._left == 0
        drawn *= self._limit / drawn.norm(dim=-1, keepdim=True)
        self._direction = torch.where(begins.unsqueeze(-1), drawn, self._direction)
        self._left = torch.where(begins, float(_PUSH_STEPS), (self._left - 1).clamp(min=0))
        return torch.where((self._left > 0).unsqueeze(-1), self._direction, move)


def script(task: str) -> Callable[[Array], Array]:
    """Return the scripted policy of a task, from observation ``[39]`` to action ``[4]``.

    Raises:
        ValueError: If there is no such task.
    """
    name = task_name(task)
    if name == "door-open-v3":
        return _open_door
    make: Any = ENV_POLICY_MAP[name]
    policy = make()

    def act(observation: Array) -> Array:
        # It warns that it asks for more than [-1, 1], and some write to what they are given.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            action: Array = policy.get_action(observation.copy())
        return action

    return act


def _open_door(observation: Array) -> Array:
    """Hook the handle from above, then pull.

    Metaworld's own script comes down before it is above the handle and counts on its momentum: with
    half the speed it opens no door.
    """
    hand, handle = observation[:3], observation[4:7]
    behind = handle + np.array([0.01, 0.02, 0.0])
    beside = float(np.linalg.norm(hand[:2] - behind[:2]))
    height = hand[2] - handle[2]
    if height < 0.05 and beside < 0.13:
        target = handle - np.array([0.05, 0.0, 0.0])
    elif beside < 0.035:
        target = behind
    else:
        target = behind + np.array([0.0, 0.0, 0.2])
    return np.append(np.clip(25 * (target - hand), -1, 1), 1.0)
