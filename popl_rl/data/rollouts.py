"""Lockstep rollouts: many Gymnasium environments, one batched policy call per step."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD

__all__ = [
    "MASK",
    "EnvBatch",
    "Outcome",
    "Start",
    "clear_after_end",
    "lockstep",
    "numeric_info",
    "stack_resets",
]

#: What ``reset`` returns, and ``step``.
Start = tuple[Any, dict[str, Any]]
Outcome = tuple[Any, float, bool, bool, dict[str, Any]]

#: Key of the ``[B, H]`` bool mask of the steps that were really taken.
MASK = "mask"


class EnvBatch(Protocol):
    """Environments of one kind that advance together, wherever they are."""

    def reset(self, seeds: Sequence[int]) -> list[Start]:
        """Begin an episode from each seed, in as many environments."""
        ...

    def step(self, where: Sequence[int], actions: np.ndarray) -> Iterable[Outcome]:
        """Step the environments of these numbers, each by its own row of ``actions``."""
        ...


class _OwnEnvs:
    """Environments of this process."""

    def __init__(self, envs: Sequence[gymnasium.Env[Any, Any]]) -> None:
        self.envs = envs

    def reset(self, seeds: Sequence[int]) -> list[Start]:
        return [env.reset(seed=int(seed)) for env, seed in zip(self.envs, seeds, strict=True)]

    def step(self, where: Sequence[int], actions: np.ndarray) -> Iterable[Outcome]:
        envs = self.envs
        return (envs[index].step(actions[index]) for index in where)  # type: ignore[misc]


def numeric_info(info: dict[str, Any]) -> dict[str, float | int]:
    """The plain numbers of an ``info`` dictionary, which become ``("info", name)`` keys."""
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in info.items()
        if isinstance(value, (bool, int, float, np.number, np.bool_))
    }


def lockstep(
    envs: Sequence[gymnasium.Env[Any, Any]] | EnvBatch,
    act: Callable[[TensorDictBase], Tensor],
    *,
    seeds: Sequence[int],
    max_steps: int,
) -> TensorDict:
    """Roll one episode in every environment, all advancing together.

    Args:
        envs: B environments of one kind, or a batch of as many as there are seeds.
        act: Maps a TensorDict ``[B]`` with ``observation`` and ``("info", ...)`` of the current
            step to actions ``[B]`` or ``[B, A]``. Rows of finished episodes are asked too and
            their answers ignored.
        seeds: Seed of each environment's reset, ``B`` of them.
        max_steps: Steps H after which an episode is cut.

    Returns:
        TensorDict of batch size ``[B, H]`` with ``observation``, ``action``, ``reward``,
        ``("info", ...)`` (that of the step's outcome) and ``mask``; steps after an episode's end
        hold zeros and ``mask`` False. A number that an ``info`` lacks counts as 0 there, and one
        that no reset gives is not shown to ``act`` before the first step.

    Raises:
        ValueError: If there are no environments, the numbers of environments and seeds differ, or
            ``max_steps`` is not positive.
    """
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}")
    batch = _as_batch(envs, seeds)
    count = len(seeds)
    starts = batch.reset(seeds)
    observation, info = stack_resets(starts)
    infos = [start[1] for start in starts]
    names = _Names(infos)
    alive = np.ones(count, dtype=bool)
    frames: list[tuple[Tensor, Tensor, np.ndarray, np.ndarray, dict[str, Tensor]]] = []
    for _ in range(max_steps):
        seen = torch.from_numpy(observation)
        current = TensorDict({OBSERVATION: seen, INFO: TensorDict(info, count)}, count)
        action = act(current)
        reward, mask = np.zeros(count, dtype=np.float32), alive.copy()
        observation = observation.copy()
        where = mask.nonzero()[0].tolist()
        outcomes = batch.step(where, action.numpy())
        for index, outcome in zip(where, outcomes, strict=True):
            observation[index], reward[index], ended, cut, infos[index] = outcome
            if ended or cut:
                alive[index] = False
            names.add(infos[index])
        info = _stack_info(infos, names)
        frames.append((seen, action, reward, mask, info))
        if not alive.any():
            break
    observations, actions, rewards, masks, about = zip(*frames, strict=True)
    return clear_after_end(
        TensorDict(
            {
                OBSERVATION: torch.stack(observations, 1),
                ACTION: torch.stack(actions, 1),
                REWARD: torch.from_numpy(np.stack(rewards, 1)),
                INFO: {name: _over_time(about, name) for name in names.known},
                MASK: torch.from_numpy(np.stack(masks, 1)),
            },
            [count, len(frames)],
        )
    )


def _as_batch(envs: Sequence[gymnasium.Env[Any, Any]] | EnvBatch, seeds: Sequence[int]) -> EnvBatch:
    if not isinstance(envs, Sequence):
        return envs
    if not envs:
        raise ValueError("envs must hold at least one environment, got none")
    if len(envs) != len(seeds):
        raise ValueError(f"seeds must be one per environment ({len(envs)}), got {len(seeds)}")
    return _OwnEnvs(envs)


def stack_resets(
    starts: Sequence[tuple[Any, dict[str, Any]]],
) -> tuple[np.ndarray, dict[str, Tensor]]:
    """First observations ``[B, ...]`` and the numbers in first infos, ``[B]`` each."""
    observation = np.stack([np.asarray(start[0], dtype=np.float32) for start in starts])
    infos = [start[1] for start in starts]
    return observation, _stack_info(infos, _Names(infos))


def clear_after_end(episodes: TensorDict) -> TensorDict:
    """Episodes ``[B, H]`` with zeros wherever ``mask`` says that there was no step, in place."""
    gone = ~episodes[MASK]
    if gone.any():
        for value in episodes.values(True, True):
            value.masked_fill_(gone.view(*gone.shape, *[1] * (value.ndim - 2)), 0)
    return episodes


class _Names:
    """Names of the numbers in infos, in the order in which they come up."""

    def __init__(self, infos: Sequence[dict[str, Any]]) -> None:
        self.known: dict[str, None] = {}
        self._seen: set[str] = set()
        for info in infos:
            self.add(info)

    def add(self, info: dict[str, Any]) -> None:
        """Look whether there are new ones; where there are none, this is no more than a look."""
        if not info.keys() <= self._seen:
            numbers = numeric_info(info)
            self.known |= dict.fromkeys(numbers)
            # What is no number may be one at another step.
            self._seen |= numbers.keys()


def _stack_info(infos: Sequence[dict[str, Any]], names: _Names) -> dict[str, Tensor]:
    """Column ``[B]`` of each name: bool, int64 or float32; 0 where an info lacks it."""
    columns = {}
    for name in names.known:
        column = np.array([info.get(name, 0) for info in infos])
        if column.dtype.kind not in "biuf":
            column = np.array([numeric_info(info).get(name, 0) for info in infos])
        kind = {"b": np.bool_, "i": np.int64, "u": np.int64}.get(column.dtype.kind, np.float32)
        columns[name] = torch.from_numpy(column.astype(kind, copy=False))
    return columns


def _over_time(columns: Sequence[dict[str, Tensor]], name: str) -> Tensor:
    """The columns of a name as ``[B, H]``; 0 before the step at which it first comes up."""
    first = next(each[name] for each in columns if name in each)
    return torch.stack([each.get(name, torch.zeros_like(first)) for each in columns], 1)
