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
_OPEN, _CLOSE = -1.0, 1.0  # what the gripper is told


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
    if name in _OWN:
        return _OWN[name]
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
    return _hand(hand, target, _CLOSE)


def _sweep_into(observation: Array) -> Array:
    """Come down on the block, hold it, then drag it into the hole.

    Metaworld's own script closes the gripper 15 cm above the block: slowly, it arrives closed.
    """
    hand, block, hole = observation[:3], observation[4:7], observation[-3:]
    grasp = block + np.array([-0.005, 0.0, 0.01])
    beside = float(np.linalg.norm(hand[:2] - grasp[:2]))
    height = hand[2] - grasp[2]
    is_down = height < 0.04 and beside < 0.06  # the block lags a little while it is dragged
    if beside > 0.04 and not is_down:
        return _hand(hand, grasp + np.array([0.0, 0.0, 0.2]), _OPEN)
    if height > 0.03:
        return _hand(hand, grasp, _OPEN)
    return _hand(hand, grasp if observation[3] > 0.7 else hole, _CLOSE)


def _insert_peg(observation: Array) -> Array:
    """Come down on the peg, hold it, lift it before the hole, then push it in.

    Metaworld's own script closes the gripper on the way down, as above, and leaves without
    waiting for the peg.
    """
    hand, peg = observation[:3], observation[4:7]
    hole = np.array([-0.35, observation[-2], 0.16])  # behind it, so that nothing slows down
    if float(np.linalg.norm(hand[:2] - peg[:2])) > 0.04:
        return _hand(hand, peg + np.array([0.0, 0.0, 0.3]), _OPEN)
    if abs(hand[2] - peg[2]) > 0.025:
        return _hand(hand, peg, _OPEN)
    if observation[3] > 0.5:
        return _hand(hand, peg, _CLOSE)
    is_before = float(np.linalg.norm(peg[1:] - hole[1:])) <= 0.03
    return _hand(hand, hole if is_before else hole + np.array([0.4, 0.0, 0.0]), _CLOSE)


def _hand(hand: Array, target: Array, grip: float) -> Array:
    """The action ``[4]`` that moves the hand to a place."""
    return np.append(np.clip(25 * (target - hand), -1, 1), grip)


_OWN = {
    "door-open-v3": _open_door,
    "peg-insert-side-v3": _insert_peg,
    "sweep-into-v3": _sweep_into,
}
