"""Environments as a run uses them, and what each offers beyond Gymnasium's interface.

Where actions are ``Discrete(n, start)``, everything about an environment (its steps, its table, its
behaviours, segments) has them from ``start`` on; ``indexed`` and ``counting_from_zero`` are the
border to learners, who count them from 0.
"""

import fnmatch
import importlib.util
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.adapters import adapt_behaviour, adapted, as_gymnasium, native_spaces
from popl_rl.data.behaviours import (
    Behaviour,
    first_action,
    random_behaviour,
    table_behaviour,
)
from popl_rl.data.features import Extracted, with_features
from popl_rl.data.plugged import (
    CheckedEnv,
    Collect,
    checked_behaviour,
    checked_behaviours,
    checked_collect,
    checked_table,
)
from popl_rl.data.tables import Table
from popl_rl.keys import ACTION
from popl_rl.plug_ins import defined, failure, is_foreign
from popl_rl.processes import Workers
from popl_rl.registry import resolve

__all__ = [
    "World",
    "behaviour_shares",
    "counting_from_zero",
    "indexed",
    "is_stateless",
    "make_world",
    "offered",
]

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]


@dataclass(frozen=True)
class World:
    """An environment and what it offers.

    Attributes:
        make: Builds an environment to act in.
        make_for_data: Builds an environment to collect segments in.
        env: One environment, for its spaces and its picture.
        behaviours: What the data shows.
        shares: Share of each behaviour in the data.
        table: Exact model, if the environment exposes one.
        collect: The environment's own way to collect segments, if it has one, in the place of
            ``behaviours``.
        workers: Processes that step environments side by side; this one alone if None.
    """

    make: MakeEnv
    make_for_data: MakeEnv
    env: gymnasium.Env[Any, Any]
    behaviours: Mapping[str, Behaviour]
    shares: Mapping[str, float]
    table: Table | None
    collect: Collect | None = None
    workers: Workers | None = None


class _MakeByReference:
    """Makes an environment from a reference, in any process that it is sent to."""

    def __init__(
        self, factory: str, env_id: str | None, options: Mapping[str, Any], features: str | None
    ) -> None:
        self.factory, self.env_id, self.options = factory, env_id, options
        self.features = features
        self._make_env: Callable[..., gymnasium.Env[Any, Any]] = resolve("env", factory)

    def __reduce__(self) -> tuple[Any, ...]:
        return _MakeByReference, (self.factory, self.env_id, self.options, self.features)

    def __call__(self) -> gymnasium.Env[Any, Any]:
        make_env = self._make_env
        leading = () if self.env_id is None else (self.env_id,)
        build = _make_by_id if self.env_id is not None and make_env is gymnasium.make else make_env
        try:
            env = build(*leading, **self.options)
        except (TypeError, gymnasium.error.Error) as error:
            raise ValueError(
                f"env.factory {self.factory!r} cannot be built with id {self.env_id!r} and options "
                f"{self.options}: {error} ({defined(make_env)})"
            ) from error
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) or not is_foreign(make_env):
                raise  # ours say in their own words which option is off
            raise failure("env", self.factory, "making it", error, make_env) from error
        name = self.factory if self.env_id is None else self.env_id
        return _prepared(env, self.factory, name, self.features)


def make_world(
    factory: str,
    *,
    env_id: str | None = None,
    options: Mapping[str, Any] | None = None,
    data_options: Mapping[str, Any] | None = None,
    mixture: Mapping[str, float] | None = None,
    choose: Callable[["World"], Mapping[str, Behaviour]] | None = None,
    workers: Workers | None = None,
    features: str | None = None,
) -> World:
    """Resolve an environment and read off what it offers.

    An environment is any Gymnasium environment, or one of TorchRL's, whose spaces are adapted as
    ``popl_rl.data.adapters`` says. Three methods are used if it, or a wrapper around it, has them:
    ``transition_table()`` (exact regret labels), ``behaviours()`` (what the data shows: by name,
    tables ``[S, A]`` of action probabilities or functions; uniformly random otherwise), and
    ``collect_segments(...)`` (see ``Collect``), which collects the data itself.

    Args:
        factory: Reference of kind ``env``.
        env_id: First argument of the factory, such as a Gymnasium id; None for none.
        options: Further arguments of the factory.
        data_options: What differs from these where segments are collected.
        mixture: Shares of the behaviours, see ``behaviour_shares``.
        choose: Gives other behaviours in the place of those that the environment has, which may be
            none; None for these.
        workers: Processes that step environments side by side; this one alone if None.
        features: Reference of a frozen extractor whose features are observed in the place of what
            the environment shows, see ``popl_rl.data.features``; None for none.

    Raises:
        ValueError: If the environment cannot be resolved or built, what it offers makes no sense,
            or ``mixture`` names behaviours that it does not have.
        TypeError: If it has no behaviours and its actions cannot be drawn at random, see
            ``popl_rl.data.behaviours.random_behaviour``.
    """
    own = dict(options or {})
    make = _MakeByReference(factory, env_id, own, features)
    make_for_data = _MakeByReference(factory, env_id, {**own, **(data_options or {})}, features)
    env = make()
    space, first = env.action_space, first_action(env.action_space)
    native = native_spaces(env)[1]
    table = checked_table(offered(env, "transition_table"), factory)
    if table is not None and features is not None:
        table = with_features(table, env)
    given = checked_behaviours(offered(env, "behaviours"), factory)
    behaviours: Mapping[str, Behaviour] = {
        name: table_behaviour(what, first=first)
        if isinstance(what, Tensor)
        else adapt_behaviour(checked_behaviour(what, factory, name, native), native)
        for name, what in given.items()
    }
    collect = None
    if offered(env, "collect_segments") is not None:
        if features is not None:
            raise ValueError(
                f"env.features must be left out, since {factory!r} collects segments itself; let "
                "collect_segments() and its observations give the features"
            )
        collect = checked_collect(offered(make_for_data(), "collect_segments"), factory)
    world = World(make, make_for_data, env, behaviours, {}, table, collect, workers)
    if choose is not None:
        behaviours = choose(world)
    elif not behaviours:
        behaviours = {"random": random_behaviour(space)}
    shares = behaviour_shares(list(behaviours), mixture)
    return replace(world, behaviours=behaviours, shares=shares)


def _prepared(env: Any, factory: str, name: str, features: str | None) -> gymnasium.Env[Any, Any]:
    """What a factory has returned, checked, adapted, and with actions clipped to their bounds."""
    try:
        env = as_gymnasium(env)
        if not isinstance(env, gymnasium.Env):
            raise ValueError(f"must return a gymnasium.Env or a TorchRL EnvBase, got {type(env)}")
        seen = env if features is None else Extracted(env, features)
        made = CheckedEnv(adapted(seen), name)
    except (TypeError, ValueError) as error:
        raise type(error)(f"env.factory {factory!r}: {error}") from error
    space = made.action_space
    if not isinstance(space, gymnasium.spaces.Box):
        return made
    # A Gaussian policy's mean knows no bounds. Gymnasium's own ClipAction would hide the bounds,
    # which random actions need.
    clip = partial(np.clip, a_min=space.low, a_max=space.high)
    return gymnasium.wrappers.TransformAction(made, clip, space)


def offered(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """What an environment or a wrapper around it has under a name, the outermost first, or None."""
    return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None


def _make_by_id(env_id: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make an environment by its id, importing the package that registers it if need be."""
    try:
        return gymnasium.make(env_id, **options)
    except gymnasium.error.UnregisteredEnv as error:
        # Packages register their ids when imported, and mostly begin them with their own name.
        start = re.split(r"[-/:]", env_id, maxsplit=1)[0].lower()
        for package in (start, f"{start}_py"):
            if ":" not in env_id and package and importlib.util.find_spec(package) is not None:
                return gymnasium.make(f"{package}:{env_id}", **options)
        raise gymnasium.error.UnregisteredEnv(
            f"{error} Ids of other packages begin with the package that is to be imported, as in "
            "env.id=minigrid:MiniGrid-Empty-5x5-v0."
        ) from error


def behaviour_shares(names: Sequence[str], mixture: Mapping[str, float] | None) -> dict[str, float]:
    """Share of each behaviour in the data.

    Args:
        names: Behaviours that there are.
        mixture: Shares by name or by pattern (``"planner/*"``), which the matching behaviours
            divide equally; None or empty for equal shares of all.

    Raises:
        ValueError: If a pattern matches nothing.
    """
    if not mixture:
        return dict.fromkeys(names, 1 / len(names))
    shares = dict.fromkeys(names, 0.0)
    for pattern, share in mixture.items():
        matching = fnmatch.filter(names, pattern)
        if not matching:
            raise ValueError(
                f"env.mixture {pattern!r} matches no behaviour; there are {', '.join(names)}"
            )
        for name in matching:
            shares[name] += share / len(matching)
    return shares


def is_stateless(env: gymnasium.Env[Any, Any]) -> bool:
    """Whether an environment has a single action, so that one can only judge what is seen."""
    return isinstance(env.action_space, gymnasium.spaces.Discrete) and env.action_space.n == 1


def indexed(segments: TensorDictBase, action_space: gymnasium.Space[Any]) -> TensorDictBase:
    """Segments as a learner reads them: discrete actions counted from 0.

    Args:
        segments: TensorDict ``[N, T]`` with actions as the environment takes them.
        action_space: The environment's actions.

    Returns:
        The segments themselves where nothing changes; a shallow copy with other actions elsewhere.
    """
    first = first_action(action_space)
    if first == 0:
        return segments
    copy: TensorDictBase = segments.copy()
    return copy.set(ACTION, segments[ACTION] - first)


def counting_from_zero(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """The environment for a learner: discrete actions counted from 0."""
    space = env.action_space
    first = first_action(space)
    if first == 0:
        return env
    counted = gymnasium.spaces.Discrete(int(cast("gymnasium.spaces.Discrete", space).n))
    return gymnasium.wrappers.TransformAction(env, lambda action: action + first, counted)
