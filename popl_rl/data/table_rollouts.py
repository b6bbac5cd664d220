"""Rollouts of many episodes: by an environment's table where it lists one, else in lockstep.

A table answers for all episodes with one look-up a step, some ten times as fast as stepping
environments one after the other. Its episodes are those of stepping to the bit.
"""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.adapters import Native
from popl_rl.data.behaviours import first_action
from popl_rl.data.plugged import CheckedEnv
from popl_rl.data.process_rollouts import RemoteEnvs
from popl_rl.data.rollouts import MASK, clear_after_end, lockstep, stack_resets
from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.processes import Workers

__all__ = ["Rollouts", "table_lockstep"]


class Rollouts:
    """Rolls episodes in environments of one kind, by their table if it says when episodes are cut.

    An environment under a wrapper is stepped, whatever it lists: the wrapper may change things. One
    that lists its transitions without ``popl_rl.data.tables.Table.horizon`` is stepped too.

    Args:
        make_env: Builds one environment.
        workers: Processes that step environments side by side, of which a table has no need; this
            one steps them if None.

    Attributes:
        env: One of the environments, for its spaces.
        table: What episodes are looked up in; None where environments are stepped.

    Example:
        >>> with Rollouts(make_env) as roll:  # doctest: +SKIP
        ...     episodes = roll(act, seeds=range(100), max_steps=60)
    """

    def __init__(
        self, make_env: Callable[[], gymnasium.Env[Any, Any]], workers: Workers | None = None
    ) -> None:
        self._make_env = make_env
        self.env = make_env()
        self._envs = [self.env]
        self.table = _complete_table(self.env)
        self._remote = None
        if workers is not None and self.table is None:
            self._remote = RemoteEnvs(make_env, workers)

    def __call__(
        self,
        act: Callable[[TensorDictBase], Tensor],
        *,
        seeds: Sequence[int],
        max_steps: int,
    ) -> TensorDict:
        """Roll one episode from each seed; see ``popl_rl.data.rollouts.lockstep``."""
        if self.table is not None:
            return table_lockstep(self.env, self.table, act, seeds=seeds, max_steps=max_steps)
        if self._remote is not None:
            return lockstep(self._remote, act, seeds=seeds, max_steps=max_steps)
        self._envs += [self._make_env() for _ in range(len(seeds) - len(self._envs))]
        return lockstep(self._envs[: len(seeds)], act, seeds=seeds, max_steps=max_steps)

    def __enter__(self) -> "Rollouts":
        return self

    def __exit__(self, *_: object) -> None:
        for env in self._envs:
            env.close()
        if self._remote is not None:
            self._remote.close()


def table_lockstep(
    env: gymnasium.Env[Any, Any],
    table: Table,
    act: Callable[[TensorDictBase], Tensor],
    *,
    seeds: Sequence[int],
    max_steps: int,
) -> TensorDict:
    """Roll one episode from each seed by look-ups in a table.

    Args:
        env: An environment of discrete actions, which is reset once for each distinct seed and
            never stepped.
        table: Every transition of it, with a ``horizon``.
        act: As for ``popl_rl.data.rollouts.lockstep``.
        seeds: Seeds of the B resets.
        max_steps: Steps H after which an episode is cut, if the environment does not cut it before.

    Returns:
        What ``popl_rl.data.rollouts.lockstep`` returns, with the infos that the table lists.

    Raises:
        ValueError: If there are no seeds, ``max_steps`` is not positive, the table has no horizon
            or does not fit a reset, or an action is out of range.
    """
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}")
    if not len(seeds):
        raise ValueError("seeds must hold at least one seed, got none")
    if table.horizon is None:
        raise ValueError("the table must have a horizon, got None; use lockstep")
    count, num_actions = len(seeds), table.next_state.shape[1]
    first = first_action(env.action_space)
    listed = _Listed(table)
    observation, info = _starts(env, seeds)
    state = info["state"]
    if not torch.equal(observation, listed.observation[state]):
        raise ValueError(
            "transition_table() must list the observations that reset returns, got others; build "
            "both from one function"
        )
    entry = state * num_actions
    alive = torch.ones(count, dtype=torch.bool)
    entries, actions, masks = [], [], []
    for _ in range(int(min(max_steps, table.horizon))):
        seen = TensorDict({OBSERVATION: observation, INFO: TensorDict(info, count)}, count)
        action = act(seen)
        choice = action.long() - first
        if bool(((choice < 0) | (choice >= num_actions))[alive].any()):
            raise ValueError(
                f"actions must be from {first} to {first + num_actions - 1}, got "
                f"{action[alive].unique().tolist()}"
            )
        # Episodes that are over stay at their last entry, whatever is chosen for them.
        entry = torch.where(alive, state * num_actions + choice, entry)
        entries.append(entry)
        actions.append(action)
        masks.append(alive)
        alive = alive & ~listed.terminal[entry]
        state = listed.next_state[entry]
        if not alive.any():
            break
        observation, info = listed.observation[state], listed.infos(entry)
    rows = torch.stack(entries, 1)
    return clear_after_end(
        TensorDict(
            {
                OBSERVATION: listed.observation[rows // num_actions],
                ACTION: torch.stack(actions, 1),
                REWARD: listed.reward[rows],
                INFO: listed.infos(rows),
                MASK: torch.stack(masks, 1),
            },
            rows.shape,
        )
    )


class _Listed:
    """A table's columns, one entry for each state and action, in the types of rollouts."""

    def __init__(self, table: Table) -> None:
        steps = table.steps
        self.observation = steps[OBSERVATION][:, 0].float()
        self.reward = steps[REWARD].float().flatten()
        self.terminal = table.terminal.flatten()
        self.next_state = table.next_state.flatten()
        listed_names = steps[INFO].keys()
        self._info = {str(name): _as_number(steps[INFO, name]) for name in listed_names}

    def infos(self, entry: Tensor) -> dict[str, Tensor]:
        """Infos of the outcome of steps ``[...]``."""
        return {name: column[entry] for name, column in self._info.items()}


def _as_number(column: Tensor) -> Tensor:
    if column.dtype != torch.bool:
        column = column.float() if column.is_floating_point() else column.long()
    return column.flatten()


def _starts(env: gymnasium.Env[Any, Any], seeds: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
    """First observations ``[B, O]`` and infos ``[B]``; equal seeds have equal ones."""
    place = {int(seed): number for number, seed in enumerate(dict.fromkeys(seeds))}
    observation, info = stack_resets([env.reset(seed=seed) for seed in place])
    row = torch.tensor([place[int(seed)] for seed in seeds])
    return torch.from_numpy(observation)[row], {name: value[row] for name, value in info.items()}


def _complete_table(env: gymnasium.Env[Any, Any]) -> Table | None:
    """The table of an environment that says everything, or None."""
    while isinstance(env, CheckedEnv | Native):  # which change nothing
        env = env.env
    list_transitions = getattr(env, "transition_table", None)
    table = None if list_transitions is None else list_transitions()
    return table if isinstance(table, Table) and table.horizon is not None else None
