"""Whole episodes for PPO: the steps, how they ended, and what they had gathered."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.keys import ACTION, OBSERVATION

__all__ = ["Ending", "clip_actions", "roll_episodes", "running_returns"]


class Ending(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps how an episode ended, which lockstep does not record, and keeps actions in bounds.

    Args:
        env: What is wrapped. Its rewards and infos are left out.

    Attributes:
        last: The observation after the last step.
        terminated: Whether the environment ended the episode, rather than a limit on its length.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.last: Any = None
        self.terminated = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the info is empty."""
        observation, _ = self.env.reset(seed=seed, options=options)
        return observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action, clipped into the action space; the reward is 0 and the info empty."""
        space = self.env.action_space
        if isinstance(space, gymnasium.spaces.Box):
            action = np.clip(action, space.low, space.high)
        self.last, _, self.terminated, truncated, _ = self.env.step(action)
        # A reward that is not used, and no info, which would be copied into every step.
        return self.last, 0.0, self.terminated, truncated, {}


def clip_actions(space: gymnasium.Space[Any], action: Tensor) -> Tensor:
    """Actions ``[B]`` or ``[B, A]`` as an ``Ending`` carries them out, in the same shape."""
    if not isinstance(space, gymnasium.spaces.Box):
        return action
    return action.clamp(torch.from_numpy(space.low), torch.from_numpy(space.high)).to(action.dtype)


def roll_episodes(
    envs: Sequence[Ending],
    act: Callable[[TensorDictBase], Tensor],
    *,
    max_steps: int,
    generator: torch.Generator,
) -> TensorDict:
    """Play one episode in each environment.

    Args:
        envs: E environments, which advance together.
        act: Maps a batch of steps ``[E]`` to actions ``[E]`` or ``[E, A]``.
        max_steps: Steps after which an episode is cut: done, but not terminated.
        generator: Source of the seeds of the episodes.

    Returns:
        TensorDict ``[S]``, one episode after the other: ``observation``, ``action``, and below
        ``next`` the following ``observation``, ``done`` and ``terminated``, ``[S, 1]`` each.
    """
    seeds = torch.randint(2**31, (len(envs),), generator=generator).tolist()
    episodes = lockstep(envs, act, seeds=seeds, max_steps=max_steps)
    mask = episodes[MASK]
    rows, last = torch.arange(len(envs)), mask.sum(1) - 1
    # What follows a step is seen at the next one, but for the last, whose outcome is elsewhere.
    following = episodes[OBSERVATION].roll(-1, 1)
    following[rows, last] = torch.stack(
        [torch.as_tensor(env.last, dtype=following.dtype) for env in envs]
    )
    done, terminated = torch.zeros(2, *mask.shape, 1, dtype=torch.bool)
    done[rows, last] = True
    terminated[rows, last, 0] = torch.tensor([env.terminated for env in envs])
    episodes = episodes.select(OBSERVATION, ACTION)
    episodes["next"] = TensorDict(
        {OBSERVATION: following, "done": done, "terminated": terminated}, episodes.batch_size
    )
    return episodes[mask]


def running_returns(gain: Tensor, done: Tensor, discount: float) -> Tensor:
    """Discounted sum of an episode's rewards up to each step.

    Args:
        gain: Rewards of episodes, one after the other, ``[S]``.
        done: Whether a step is the last of its episode, ``[S]``, bool.
        discount: Factor by which a sum shrinks at each step.

    Returns:
        ``[S, 1]``.
    """
    sums, total = [], 0.0
    for value, ends in zip(gain.tolist(), done.tolist(), strict=True):
        total = discount * total + value
        sums.append(total)
        total = 0.0 if ends else total
    return torch.tensor(sums).unsqueeze(-1)
