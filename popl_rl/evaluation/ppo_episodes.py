"""Whole episodes for PPO: the steps, how they ended, and what they had gathered."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.evaluation.measures import with_last_step_repeated
from popl_rl.keys import ACTION, OBSERVATION, REWARD

__all__ = ["Ending", "RewardFunction", "clip_actions", "roll_episodes", "running_returns"]

#: Maps steps ``[E, H]`` of episodes, as ``popl_rl.data.rollouts.lockstep`` gives them, to the
#: reward of each, ``[E, H]``.
RewardFunction = Callable[[TensorDictBase], Tensor]


class Ending(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps how an episode ended, which lockstep does not record, and keeps actions in bounds.

    Args:
        env: What is wrapped.
        tells: Whether the environment's own rewards and infos are handed on. They cost time, and
            most rewards that are learnt do not read them.

    Attributes:
        last: The observation after the last step.
        terminated: Whether the environment ended the episode, rather than a limit on its length.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], *, tells: bool = False) -> None:
        super().__init__(env)
        self.tells = tells
        self.last: Any = None
        self.terminated = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info if self.tells else {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action, clipped into the action space."""
        space = self.env.action_space
        if isinstance(space, gymnasium.spaces.Box):
            action = np.clip(action, space.low, space.high)
        self.last, reward, self.terminated, truncated, info = self.env.step(action)
        if not self.tells:
            reward, info = 0.0, {}
        return self.last, float(reward), self.terminated, truncated, info


def clip_actions(space: gymnasium.Space[Any], action: Tensor) -> Tensor:
    """Actions ``[...]`` or ``[..., A]`` as an ``Ending`` carries them out, in the same shape."""
    if not isinstance(space, gymnasium.spaces.Box):
        return action
    return action.clamp(torch.from_numpy(space.low), torch.from_numpy(space.high)).to(action.dtype)


def roll_episodes(
    envs: Sequence[Ending],
    act: Callable[[TensorDictBase], Tensor],
    reward: RewardFunction,
    *,
    max_steps: int,
    generator: torch.Generator,
) -> TensorDict:
    """Play one episode in each environment.

    Args:
        envs: E environments, which advance together.
        act: Maps a batch of steps ``[E]`` to actions ``[E]`` or ``[E, A]``.
        reward: Rewards episodes ``[E, H]``, whose actions are within the bounds of the action
            space. What stands after an episode's end is its last step again.
        max_steps: Steps after which an episode is cut: done, but not terminated.
        generator: Source of the seeds of the episodes.

    Returns:
        TensorDict ``[S]``, one episode after the other: ``observation``, ``action``, and below
        ``next`` the following ``observation``, and ``reward``, ``done`` and ``terminated``,
        ``[S, 1]`` each.

    Raises:
        TypeError: If ``reward`` gives no floating-point tensor.
        ValueError: If it gives another shape than ``[E, H]``, or values that are not finite.
    """
    seeds = torch.randint(2**31, (len(envs),), generator=generator).tolist()
    episodes = lockstep(envs, act, seeds=seeds, max_steps=max_steps)
    mask = episodes[MASK]
    gain = _rewards(reward, with_last_step_repeated(episodes), envs[0].action_space)
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
        {
            OBSERVATION: following,
            REWARD: gain.unsqueeze(-1),
            "done": done,
            "terminated": terminated,
        },
        episodes.batch_size,
    )
    return episodes[mask]


@torch.no_grad()
def _rewards(
    reward: RewardFunction, episodes: TensorDictBase, space: gymnasium.Space[Any]
) -> Tensor:
    """Reward of each step of episodes ``[E, H]``, checked, float32 ``[E, H]``."""
    shown = episodes.copy().set(ACTION, clip_actions(space, episodes[ACTION]))
    gain = reward(shown)
    if not isinstance(gain, Tensor) or not gain.is_floating_point():
        kind = gain.dtype if isinstance(gain, Tensor) else type(gain).__name__
        raise TypeError(
            f"reward must give a floating-point tensor, got {kind}; call .float() on it"
        )
    if gain.shape != episodes.batch_size:
        raise ValueError(
            f"reward must give one value for each step, shape {list(episodes.batch_size)}, got "
            f"{list(gain.shape)}"
        )
    if not bool(gain.isfinite().all()):
        raise ValueError(
            f"reward must give finite values, got {int((~gain.isfinite()).sum())} NaN or infinite "
            f"ones in {gain.numel()} steps; look at where it comes from"
        )
    return gain.float()


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
