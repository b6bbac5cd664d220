"""Calling what other people wrote, so that whatever it does wrong can be told."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

import gymnasium
import torch
from tensordict import TensorDictBase

from popl_rl import registry
from popl_rl.data.adapters import adapted, as_gymnasium
from popl_rl.data.behaviours import random_behaviour
from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.data.segments import cut_segments
from popl_rl.plug_ins import call

__all__ = [
    "Env",
    "EnvReference",
    "identical",
    "made_env",
    "name_of",
    "random_segments",
]

Env: TypeAlias = gymnasium.Env[Any, Any]
EnvReference: TypeAlias = str | Env | Callable[..., Env]


def name_of(thing: Any) -> str:
    """What messages call a plug-in: what follows ':' in a reference, or the object's own name."""
    if isinstance(thing, str):
        return thing.rpartition(":")[2]
    return getattr(thing, "__name__", type(thing).__name__)


@contextmanager
def made_env(
    name: str, env: EnvReference, arguments: dict[str, Any], *, flat: bool = True
) -> Iterator[Env]:
    """Yield the environment, and close it if it was made here.

    Args:
        name: What messages call it.
        env: The environment, its factory, or a reference to the factory.
        arguments: Keyword arguments of the factory.
        flat: Whether with the spaces that training sees, and not its own.
    """
    if isinstance(env, gymnasium.Env):
        if arguments:
            raise TypeError(
                f"env {name!r} is made already and takes no arguments, got {arguments}."
            )
        yield _flat(name, env) if flat else env
        return
    factory = registry.resolve("env", env) if isinstance(env, str) else env
    if not callable(factory):
        raise TypeError(
            f"env must be a gymnasium.Env, a function that makes one, or a reference to it, got a "
            f"{type(env).__name__}."
        )
    made = as_gymnasium(call("env", name, "making it", factory, **arguments))
    if not isinstance(made, gymnasium.Env):
        raise TypeError(
            f"env {name!r} must return a gymnasium.Env, got a {type(made).__name__}; subclass "
            "gymnasium.Env, or wrap what you have."
        )
    try:
        yield _flat(name, made) if flat else made
    finally:
        made.close()


def _flat(name: str, env: Env) -> Env:
    """The environment as training sees it."""
    try:
        return adapted(env)
    except (TypeError, ValueError) as error:
        raise type(error)(f"env {name!r}: {error}.") from error


def random_segments(env: Env, seed: int) -> TensorDictBase:
    """Return segments of random actions, of 5 steps unless episodes are shorter."""
    generator = torch.Generator().manual_seed(seed)
    acts = random_behaviour(env.action_space, unbounded=True)
    episodes = [
        lockstep([env], lambda step: acts(step, generator), seeds=[seed + index], max_steps=50)
        for index in range(8)
    ]
    length = min(5, *(int(episode[MASK].sum()) for episode in episodes))
    return torch.cat([cut_segments(episode, length) for episode in episodes])


def identical(one: TensorDictBase, other: TensorDictBase) -> bool:
    """Whether two TensorDicts have the same keys and, to the bit, the same values."""
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(
        torch.equal(one[key], other[key]) for key in keys
    )
