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
    info = [numeric_info(start[1]) for start in starts]
    alive = np.ones(len(envs), dtype=bool)
    frames: list[TensorDict] = []
    for _ in range(max_steps):
        current = TensorDict(
            {OBSERVATION: torch.from_numpy(observation), INFO: _stack_info(info)}, [len(envs)]
        )
        action = act(current)
        commands = action.numpy()
        reward, mask = np.zeros(len(envs), dtype=np.float32), alive.copy()
        observation = observation.copy()
        for index in np.flatnonzero(alive).tolist():
            outcome = envs[index].step(commands[index])
            observation[index], reward[index] = outcome[0], outcome[1]
            info[index] = numeric_info(outcome[4])
            alive[index] = not (outcome[2] or outcome[3])
        frame = {
            OBSERVATION: current[OBSERVATION],
            ACTION: action,
            REWARD: torch.from_numpy(reward),
            INFO: _stack_info(info),
            MASK: torch.from_numpy(mask),
        }
        frames.append(TensorDict(frame, [len(envs)]))
        if not alive.any():
            break
    episodes: TensorDict = torch.stack(frames, 1)  # type: ignore[call-overload]
    gone = ~episodes[MASK]
    for value in episodes.values(True, True):
        value[gone] = 0
    return episodes


def _stack_info(info: Sequence[dict[str, float | int]]) -> TensorDict:
    names = info[0].keys()
    columns = {name: torch.tensor([entry[name] for entry in info]) for name in names}
    return TensorDict(columns, [len(info)])
