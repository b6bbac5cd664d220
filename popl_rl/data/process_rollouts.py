"""Environments in worker processes, which step side by side; episodes are those of one process.

One process asks the policy for all environments at once, as if they were its own; the others step
those that they have. This pays where a step takes longer than to say what happened: with simulators
of physics, not with grids.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from itertools import count
from typing import Any

import gymnasium
import numpy as np

from popl_rl.data.rollouts import Outcome, Start, numeric_info
from popl_rl.processes import Workers

__all__ = ["RemoteEnvs"]

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]

_numbers = count()  # by which a worker knows to whom environments belong
_envs: dict[int, list[gymnasium.Env[Any, Any]]] = {}  # those of this process, if it is a worker


class RemoteEnvs:
    """Environments of one kind, dealt out to worker processes; see ``rollouts.EnvBatch``.

    Args:
        make_env: Builds one environment; it crosses to the workers.
        workers: The processes.
    """

    def __init__(self, make_env: MakeEnv, workers: Workers) -> None:
        self._make_env, self._workers = make_env, workers
        self._key = next(_numbers)

    def reset(self, seeds: Sequence[int]) -> list[Start]:
        """Begin an episode from each seed, in as many environments."""
        every = len(self._workers)
        replies = [
            self._workers.submit(k, _reset, self._key, self._make_env, list(seeds[k::every]))
            for k in range(min(every, len(seeds)))
        ]
        return _in_order(replies, range(len(seeds)), every)

    def step(self, where: Sequence[int], actions: np.ndarray) -> list[Outcome]:
        """Step the environments of these numbers, each by its own row of ``actions``."""
        every = len(self._workers)
        replies = []
        for k in range(every):
            own = [index for index in where if index % every == k]
            places = [index // every for index in own]
            replies.append(
                self._workers.submit(k, _step, self._key, places, actions[own]) if own else None
            )
        return _in_order(replies, where, every)

    def close(self) -> None:
        """Close the environments."""
        for k in range(len(self._workers)):
            self._workers.submit(k, _close, self._key)


def _in_order(
    replies: Sequence["Future[list[Any]] | None"], where: Sequence[int], every: int
) -> list[Any]:
    """What workers have replied, in the order of the environments."""
    told = [iter([] if reply is None else reply.result()) for reply in replies]
    return [next(told[index % every]) for index in where]


def _reset(key: int, make_env: MakeEnv, seeds: Sequence[int]) -> list[Start]:
    envs = _envs.setdefault(key, [])
    envs += [make_env() for _ in range(len(seeds) - len(envs))]
    starts = [env.reset(seed=int(seed)) for env, seed in zip(envs, seeds, strict=False)]
    return [(observation, numeric_info(info)) for observation, info in starts]


def _step(key: int, places: Sequence[int], actions: np.ndarray) -> list[Outcome]:
    envs = _envs[key]
    outcomes: list[Any] = [
        envs[place].step(action) for place, action in zip(places, actions, strict=True)
    ]
    # Of an info, lockstep rollouts keep the plain numbers.
    return [(*outcome[:4], numeric_info(outcome[4])) for outcome in outcomes]


def _close(key: int) -> None:
    for env in _envs.pop(key, []):
        env.close()
