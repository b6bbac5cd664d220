"""Checks for people who write environments and raters, and a tiny environment to try things on.

From a shell::

    python -m popl_rl.testing env two_doors --with doors=3
    python -m popl_rl.testing rater my_raters.py:tender --env two_doors

One line says what is wrong and what to do, with exit code 2, or that nothing is, with exit code 0.
Importing this module registers nothing.
"""

import argparse
import ast
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl import registry
from popl_rl._env_checks import (
    Env,
    call,
    check_behaviours,
    check_repeats,
    check_spaces,
    check_table,
    check_torchrl,
    random_steps,
)
from popl_rl.data.behaviours import random_behaviour
from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.data.segments import cut_segments
from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.raters.groups import RaterGroup, Utility
from popl_rl.raters.response import Response

__all__ = ["check_env", "check_rater", "likes_left", "likes_right", "tiny_env"]

EnvReference: TypeAlias = str | Env | Callable[..., Env]


def check_env(env: EnvReference, *, num_steps: int = 200, seed: int = 0, **arguments: Any) -> None:
    """Check that an environment can be used here; the first fault found is raised.

    Args:
        env: An environment, its factory, or a reference to the factory (see
            :mod:`popl_rl.registry`).
        num_steps: Random steps to take.
        seed: Seed of episodes and actions.
        **arguments: Keyword arguments for the factory.

    Raises:
        TypeError: If spaces, observations, rewards or infos are of another kind than expected.
        ValueError: If the environment fails, is not reproducible, gives numbers out of its space or
            not finite, changes its info keys, fails TorchRL's check, or has a transition table or
            behaviours that do not describe it.

    Example:
        >>> from popl_rl.testing import check_env, tiny_env
        >>> check_env(tiny_env)
    """
    name = _name_of(env)
    with _made(name, env, arguments) as made:
        check_spaces(name, made)
        steps = random_steps(name, made, num_steps, seed)
        check_repeats(name, steps, random_steps(name, made, num_steps, seed))
        if _offers(made, "transition_table"):
            check_table(
                name, call(name, "transition_table", _offers(made, "transition_table")), made, steps
            )
        if _offers(made, "behaviours"):
            check_behaviours(name, call(name, "behaviours", _offers(made, "behaviours")))
        check_torchrl(name, made)


def check_rater(
    rater: str | Utility, env: EnvReference | None = None, *, seed: int = 0, **arguments: Any
) -> None:
    """Check that a rater's function fits an environment; the first fault found is raised.

    Args:
        rater: A function from segments ``[B, T]`` to utilities ``[B, T]``, or a reference to one.
        env: Where segments come from, as in :func:`check_env`. None takes :func:`tiny_env`.
        seed: Seed of the random segments.
        **arguments: Keyword arguments for the environment's factory.

    Raises:
        TypeError: If the result is no floating-point tensor.
        ValueError: If the function fails, its result has the wrong shape or is not finite, changes
            from call to call or with the other segments of the batch, or if it modifies the
            segments.

    Warns:
        UserWarning: If the utility of a step depends on the other steps of its segment: labels by
            regret are then made from other utilities than labels by return.

    Example:
        >>> from popl_rl.testing import check_rater, likes_left
        >>> check_rater(likes_left)
    """
    name = _name_of(rater)
    function = registry.resolve("rater", rater) if isinstance(rater, str) else rater
    group = RaterGroup(name, function, Response())
    source = tiny_env if env is None else env
    with _made(_name_of(source), source, arguments) as made:
        segments = _random_segments(made, seed)
        list_table = _offers(made, "transition_table")
        table = list_table() if list_table else None
    before = segments.clone()
    whole = group.step_utility(segments)
    if not _identical(before, segments):
        raise ValueError(
            f"rater {name!r} must leave segments as they are, but changed them; work on a copy, as "
            "in segments['action'].clone(), and use operations without a trailing underscore."
        )
    if not torch.equal(whole, group.step_utility(segments)):
        raise ValueError(
            f"rater {name!r} must give the same utility each time, but a second call differed; "
            "leave randomness to the response model (rationality, mistake)."
        )
    if not torch.allclose(group.step_utility(segments[:1]), whole[:1], rtol=1e-4, atol=1e-5):
        raise ValueError(
            f"rater {name!r} must judge each segment by itself, but the first came out differently "
            "alone; do not normalise by, or compare with, the rest of the batch."
        )
    if table is not None:
        group.step_utility(table.steps)
    alone = group.step_utility(segments.reshape(-1, 1)).reshape(whole.shape)
    if not torch.allclose(alone, whole, rtol=1e-4, atol=1e-5):
        warnings.warn(
            f"rater {name!r} gives a step another utility alone than within its segment; labels by "
            "regret see single steps only. Use label='return', or judge each step by itself.",
            stacklevel=2,
        )


class _Walk(gymnasium.Env[Any, Any]):
    """A line of five cells; see :func:`tiny_env`."""

    _CELLS = 5

    def __init__(self, max_steps: int) -> None:
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (self._CELLS,), dtype=np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)
        self._max_steps = max_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._cell, self._time = int(self.np_random.integers(self._CELLS)), 0
        return self._observation(), {"state": self._cell, "next_state": self._cell}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        before = self._cell
        self._cell = self._after(before, int(action))
        self._time += 1
        info = {"state": before, "next_state": self._cell}
        return self._observation(), 0.0, False, self._time >= self._max_steps, info

    def transition_table(self) -> Table:
        state = torch.arange(self._CELLS).unsqueeze(1).repeat(1, 2)
        action = torch.arange(2).repeat(self._CELLS, 1)
        after = [[self._after(cell, move) for move in range(2)] for cell in range(self._CELLS)]
        next_state = torch.tensor(after)
        steps = TensorDict(
            {
                OBSERVATION: torch.eye(self._CELLS)[state],
                ACTION: action,
                REWARD: torch.zeros(state.shape),
                INFO: {"state": state, "next_state": next_state},
            },
            batch_size=state.shape,
        )
        start = torch.full((self._CELLS,), 1 / self._CELLS)
        return Table(steps, next_state, torch.zeros(state.shape, dtype=torch.bool), start)

    def _after(self, cell: int, action: int) -> int:
        return min(max(cell + (1 if action else -1), 0), self._CELLS - 1)

    def _observation(self) -> NDArray[np.float32]:
        observation: NDArray[np.float32] = np.eye(self._CELLS, dtype=np.float32)[self._cell]
        return observation


def tiny_env(*, max_steps: int = 20) -> Env:
    """Make a line of five cells to walk on, left (action 0) or right (action 1).

    Episodes start in any cell and never end but by ``max_steps``; the reward is 0. Observations are
    the cell, one-hot ``[5]``; ``info`` holds ``state`` and ``next_state``, and
    ``transition_table()`` lists all steps.
    """
    return _Walk(max_steps)


def likes_left(segments: TensorDictBase) -> Tensor:
    """Want to be on the left of :func:`tiny_env`: 1 at the left end, down to 0 at the right."""
    return 1 - likes_right(segments)


def likes_right(segments: TensorDictBase) -> Tensor:
    """Want to be on the right of :func:`tiny_env`: 0 at the left end, up to 1 at the right."""
    cell: Tensor = segments[INFO, "next_state"]
    return cell.float() / (_Walk._CELLS - 1)


def _name_of(thing: Any) -> str:
    if isinstance(thing, str):
        return thing.rpartition(":")[2]
    return getattr(thing, "__name__", type(thing).__name__)


@contextmanager
def _made(name: str, env: EnvReference, arguments: dict[str, Any]) -> Iterator[Env]:
    """Yield the environment, and close it if it was made here."""
    if isinstance(env, gymnasium.Env):
        if arguments:
            raise TypeError(
                f"env {name!r} is made already and takes no arguments, got {arguments}."
            )
        yield env
        return
    factory = registry.resolve("env", env) if isinstance(env, str) else env
    if not callable(factory):
        raise TypeError(
            f"env must be a gymnasium.Env, a function that makes one, or a reference to it, got a "
            f"{type(env).__name__}."
        )
    made = call(name, "making it", factory, **arguments)
    if not isinstance(made, gymnasium.Env):
        raise TypeError(
            f"env {name!r} must return a gymnasium.Env, got a {type(made).__name__}; subclass "
            "gymnasium.Env, or wrap what you have."
        )
    try:
        yield made
    finally:
        made.close()


def _offers(env: Env, method: str) -> Any:
    """Return an optional method of an environment, below its wrappers, or None."""
    return getattr(env.unwrapped, method, None)


def _random_segments(env: Env, seed: int) -> TensorDictBase:
    """Return segments of random actions, of 5 steps unless episodes are shorter."""
    generator = torch.Generator().manual_seed(seed)
    acts = random_behaviour(env.action_space)
    episodes = [
        lockstep([env], lambda step: acts(step, generator), seeds=[seed + index], max_steps=50)
        for index in range(8)
    ]
    length = min(5, *(int(episode[MASK].sum()) for episode in episodes))
    return torch.cat([cut_segments(episode, length) for episode in episodes])


def _identical(one: TensorDictBase, other: TensorDictBase) -> bool:
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(
        torch.equal(one[key], other[key]) for key in keys
    )


def _argument(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} must look like doors=3")
    try:
        return key, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return key, value


def main(argv: Sequence[str] | None = None) -> int:
    """Check a plug-in from the command line; return 0 if all is well, 2 with the fault on stderr.

    Args:
        argv: Arguments; None takes those of the process.
    """
    parser = argparse.ArgumentParser("python -m popl_rl.testing", description=main.__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    for kind in ("env", "rater"):
        sub = kinds.add_parser(kind)
        sub.add_argument("reference", help="a name, package.module:attr or path/file.py:attr")
        sub.add_argument(
            "--with",
            dest="arguments",
            nargs="+",
            type=_argument,
            default=[],
            metavar="KEY=VALUE",
            help="arguments of the environment, as in doors=3",
        )
    kinds.choices["rater"].add_argument("--env", help="environment whose segments are judged")
    given = parser.parse_args(argv)
    arguments = dict(given.arguments)
    try:
        if given.kind == "env":
            check_env(given.reference, **arguments)
        else:
            check_rater(given.reference, given.env, **arguments)
    except (TypeError, ValueError) as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 2
    sys.stdout.write(f"{given.kind} {given.reference}: all checks passed\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
