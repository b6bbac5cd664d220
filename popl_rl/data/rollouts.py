"""Lockstep rollouts: many Gymnasium environments, one batched policy call per step."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD

__all__ = ["MASK", "lockstep", "numeric_info"]

#: Key of the ``[B, H]`` bool mask of the steps that were really taken.
MASK = "mask"


def numeric_info(info: dict[str, Any]) -> dict[str, float | int]:
    """The plain numbers of an ``info`` dictionary, which become ``("info", name)`` keys."""
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in info.items()
        if isinstance(value, (bool, int, float, np.number, np.bool_))
    }


def lockstep(
    envs: Sequence[gymnasium.Env[Any, Any]],
    act: Callable[[TensorDictBase], Tensor],
    *,
    seeds: Sequence[int],
    max_steps: int,
) -> TensorDict:
    """Roll one episode in every environment, all advancing together.

    Args:
        envs: B environments of one kind.
        act: Maps a TensorDict ``[B]`` with ``observation`` and ``("info", ...)`` of the current
            step to actions ``[B]`` or ``[B, A]``. Rows of finished episodes are asked too and
            their answers ignored.
        seeds: Seed of each environment's reset, ``B`` of them.
        max_steps: Steps H after which an episode is cut.

    Returns:
        TensorDict of batch size ``[B, H]`` with ``observation``, ``action``, ``reward``,
        ``("info", ...)`` (that of the step's outcome) and ``mask``; steps after an episode's end
        hold zeros and ``mask`` False.

    Raises:
        ValueError: If there are no environments, the numbers of environments and seeds differ, or
            ``max_steps`` is not positive.
    """
    if not envs:
        raise ValueError("envs must hold at least one environment, got none")
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}")
    if len(envs) != len(seeds):
        raise ValueError(f"seeds must be one per environment ({len(envs)}), got {len(seeds)}")
    starts = [env.reset(seed=int(seed)) for env, seed in zip(envs, seeds, strict=True)]
    observation = np.stack([np.asarray(start[0], dtype=np.float32) for start in starts])
    infos = [start[1] for start in starts]
    names = list(numeric_info(infos[0]))
    steps = [env.step for env in envs]
    info = _stack_info(infos, names)
    alive = np.ones(len(envs), dtype=bool)
    frames: list[tuple[Tensor, Tensor, np.ndarray, np.ndarray, dict[str, Tensor]]] = []
    for _ in range(max_steps):
        seen = torch.from_numpy(observation)
        current = TensorDict({OBSERVATION: seen, INFO: TensorDict(info, len(envs))}, len(envs))
        action = act(current)
        commands = action.numpy()
        reward, mask = np.zeros(len(envs), dtype=np.float32), alive.copy()
        observation = observation.copy()
        for index in mask.nonzero()[0].tolist():
            outcome = steps[index](commands[index])
            observation[index], reward[index], ended, cut, infos[index] = outcome
            if ended or cut:
                alive[index] = False
        info = _stack_info(infos, names)
        frames.append((seen, action, reward, mask, info))
        if not alive.any():
            break
    observations, actions, rewards, masks, about = zip(*frames, strict=True)
    episodes = TensorDict(
        {
            OBSERVATION: torch.stack(observations, 1),
            ACTION: torch.stack(actions, 1),
            REWARD: torch.from_numpy(np.stack(rewards, 1)),
            INFO: {name: torch.stack([each[name] for each in about], 1) for name in names},
            MASK: torch.from_numpy(np.stack(masks, 1)),
        },
        [len(envs), len(frames)],
    )
    gone = ~episodes[MASK]
    if gone.any():
        for value in episodes.values(True, True):
            value[gone] = 0
    return episodes


def _stack_info(infos: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, Tensor]:
    """Column ``[B]`` of each name: bool, int64 or float32."""
    columns = {}
    for name in names:
        column = np.array([info[name] for info in infos])
        kind = {"b": np.bool_, "i": np.int64, "u": np.int64}.get(column.dtype.kind, np.float32)
        columns[name] = torch.from_numpy(column.astype(kind, copy=False))
    return columns
