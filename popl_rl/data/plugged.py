"""Environments of other people, and what they offer, checked wherever they are called."""

import math
from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any, Protocol, cast

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.behaviours import Behaviour, first_action
from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, OBSERVATION
from popl_rl.plug_ins import PlugInError, call, defined, failure, is_foreign, located
from popl_rl.processes import Workers

__all__ = [
    "CheckedBehaviour",
    "CheckedEnv",
    "Collect",
    "check_behaviours",
    "check_segments",
    "checked_behaviour",
    "checked_behaviours",
    "checked_collect",
    "checked_table",
]


#: Kinds of numbers that may not be finite.
_FLOATS = frozenset({float, np.float16, np.float32, np.float64})


class CheckedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose every answer is checked, and whose every failure is told.

    Observations must be finite and of the space's shape, the reward and the numbers in ``info``
    finite.

    Args:
        env: The environment.
        name: What messages call it.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], name: str) -> None:
        super().__init__(env)
        self._name = name
        self._shape = getattr(env.observation_space, "shape", None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Raises:
            PlugInError: If the environment fails, or answers something else than it should.
        """
        answer = call("env", self._name, "reset", self.env.reset, seed=seed, options=options)
        if not isinstance(answer, tuple) or len(answer) != 2:
            got = f"{len(answer)} values" if isinstance(answer, tuple) else type(answer).__name__
            raise self._fault("reset must return (observation, info)", got)
        observation, info = answer
        self._check_observation(observation, "reset")
        self._check_info(info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Act.

        Raises:
            PlugInError: If the environment fails, or answers something else than it should.
        """
        try:
            answer = self.env.step(action)
        except (KeyboardInterrupt, PlugInError):
            raise
        except BaseException as error:
            raise failure("env", self._name, "step", error, type(self.env.unwrapped)) from error
        if not isinstance(answer, tuple) or len(answer) != 5:
            got = f"{len(answer)} values" if isinstance(answer, tuple) else type(answer).__name__
            expected = "step must return (observation, reward, terminated, truncated, info)"
            raise self._fault(expected, got)
        observation, reward, terminated, truncated, info = answer
        self._check_observation(observation, "step")
        if not _is_finite(reward):
            raise self._fault("the reward must be a finite number", repr(reward))
        for ended in (terminated, truncated):
            if not isinstance(ended, bool | np.bool_ | int):
                raise self._fault("terminated and truncated must be bools", type(ended).__name__)
        self._check_info(info)
        return observation, reward, bool(terminated), bool(truncated), info

    def render(self) -> Any:
        """Draw.

        Raises:
            PlugInError: If the environment fails.
        """
        return call("env", self._name, "render", self.env.render)

    def _check_observation(self, observation: Any, doing: str) -> None:
        is_usual = type(observation) is np.ndarray and observation.shape == self._shape
        try:
            # A finite sum of squares is cheap, and says that each of them is finite.
            if is_usual and observation.ndim == 1 and math.isfinite(observation @ observation):
                return
            seen = np.asarray(observation)
            finite = bool(np.isfinite(seen).all())
        except (TypeError, ValueError):
            got = type(observation).__name__
            raise self._fault(f"{doing} must return observations of numbers", got) from None
        if self._shape is not None and seen.shape != self._shape:
            expected = f"{doing} must return observations of shape {list(self._shape)}"
            raise self._fault(expected, f"shape {list(seen.shape)}")
        if not finite:
            raise self._fault(f"{doing} must return finite observations", str(seen))

    def _check_info(self, info: Any) -> None:
        if not isinstance(info, dict):
            raise self._fault("infos must be dicts", f"a {type(info).__name__}")
        for name, value in info.items():
            if type(value) in _FLOATS and not math.isfinite(value):
                raise self._fault(f"info {name!r} must be finite", repr(value))

    def _fault(self, expected: str, got: str) -> PlugInError:
        place = defined(type(self.env.unwrapped))
        at = f" ({place})" if place and is_foreign(self.env.unwrapped) else ""
        return PlugInError(f"env {self._name!r}: {expected}, got {got}{at}")


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except (TypeError, ValueError, OverflowError):
        return False


class Collect(Protocol):
    """An environment's own way to collect segments."""

    def __call__(
        self,
        num_segments: int,
        length: int,
        *,
        generator: torch.Generator,
        progress: Callable[[int], None] | None = None,
        workers: Workers | None = None,
    ) -> TensorDictBase:
        """Segments ``[num_segments, length]``; ``progress`` is told how many there are so far.

        A method without the argument ``workers`` will do, which knows no other processes.
        """
        ...


def checked_table(function: Callable[[], Any] | None, name: str) -> Table | None:
    """What an environment's ``transition_table`` gives; None if it has none.

    Args:
        function: That method, or None.
        name: What messages call the environment.

    Raises:
        PlugInError: If the method fails.
        TypeError: If it gives something else.
        ValueError: If the table holds what is not finite.
    """
    found = None if function is None else call("env", name, "transition_table()", function)
    with located(function):
        if found is not None and not isinstance(found, Table):
            raise TypeError(
                f"env {name!r}: transition_table() must return a popl_rl.data.tables.Table, got a "
                f"{type(found).__name__}."
            )
        bad = [] if found is None else _not_finite(found.steps)
        if bad:
            raise ValueError(f"env {name!r}: transition_table() must be finite, got {bad} not.")
    return found


def checked_behaviours(function: Callable[[], Any] | None, name: str) -> Mapping[str, Any]:
    """What an environment's ``behaviours`` gives; none if it has no such method.

    Args:
        function: That method, or None.
        name: What messages call the environment.

    Raises:
        PlugInError: If the method fails.
        TypeError: As ``check_behaviours``.
        ValueError: As ``check_behaviours``.
    """
    if function is None:
        return {}
    found = call("env", name, "behaviours()", function)
    with located(function):
        check_behaviours(name, found)
    return cast("Mapping[str, Any]", found)


def check_behaviours(name: str, found: Any) -> None:
    """Check that behaviours are functions or tables of probabilities.

    Raises:
        TypeError: If they are of another kind.
        ValueError: If a table's rows are no probabilities.
    """
    if not isinstance(found, Mapping) or not found:
        raise TypeError(
            f"env {name!r}: behaviours() must return a dict of at least one name, got "
            f"{found if found == {} else type(found).__name__}."
        )
    for label, policy in found.items():
        if callable(policy):
            continue
        if not isinstance(policy, Tensor) or not policy.is_floating_point() or policy.ndim != 2:
            raise TypeError(
                f"env {name!r}: behaviour {label!r} must be a float tensor [states, actions] or a "
                f"function, got {getattr(policy, 'dtype', type(policy).__name__)}."
            )
        total = policy.sum(1)
        if not bool((policy >= 0).all()) or not torch.allclose(total, torch.ones_like(total)):
            raise ValueError(
                f"env {name!r}: each row of behaviour {label!r} must be probabilities that sum to "
                "1; use softmax(-1)."
            )


def checked_behaviour(
    behaviour: Behaviour, name: str, label: str, action_space: gymnasium.Space[Any]
) -> Behaviour:
    """A behaviour of other people, whose every action is checked; one of ours as it is.

    Args:
        behaviour: Maps observations ``[B]`` and a generator to actions.
        name: What messages call the environment.
        label: What messages call the behaviour.
        action_space: What actions may be.
    """
    if not is_foreign(behaviour):
        return behaviour
    return CheckedBehaviour(behaviour, name, label, action_space)


class CheckedBehaviour:
    """A behaviour whose every action is checked.

    Args:
        behaviour: Maps observations ``[B]`` and a generator to actions.
        name: What messages call the environment.
        label: What messages call the behaviour.
        space: What actions may be.
    """

    def __init__(
        self, behaviour: Behaviour, name: str, label: str, space: gymnasium.Space[Any]
    ) -> None:
        self.behaviour, self.name, self.doing = behaviour, name, f"behaviour {label!r}"
        self.space = space

    def reset(self) -> None:
        """Begin episodes, if the behaviour wants to know."""
        reset = getattr(self.behaviour, "reset", None)
        if reset is not None:
            call("env", self.name, f"reset of {self.doing}", reset)

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        """Actions of B environments.

        Raises:
            PlugInError: If the behaviour fails.
            TypeError: If it returns no actions of the space's kind, one for each environment.
            ValueError: If they are not in the space.
        """
        action = call("env", self.name, self.doing, self.behaviour, step, generator)
        with located(self.behaviour):
            self._check(action, len(step))
        return cast("Tensor", action)

    def _check(self, action: Any, batch: int) -> None:
        space, start = self.space, f"env {self.name!r}: {self.doing} must return "
        if isinstance(space, gymnasium.spaces.Discrete):
            first, last = first_action(space), first_action(space) + int(space.n) - 1
            fits = isinstance(action, Tensor) and not action.is_floating_point()
            if not fits or action.shape != (batch,):
                raise TypeError(f"{start}whole numbers [{batch}], got {_described(action)}.")
            if action.min() < first or action.max() > last:
                came = f"{int(action.min())}..{int(action.max())}"
                raise ValueError(f"{start}actions in {first}..{last}, got {came}.")
            return
        shape = (batch, *(space.shape or ()))
        if not isinstance(action, Tensor) or action.shape != shape:
            raise TypeError(f"{start}actions {list(shape)}, got {_described(action)}.")
        if not _all_finite(action):
            raise ValueError(f"{start}finite actions, got NaN or infinite ones.")


def checked_collect(function: Callable[..., Any], name: str) -> Collect:
    """An environment's own ``collect_segments``, checked.

    Args:
        function: That method.
        name: What messages call the environment.
    """

    def collect(
        num_segments: int,
        length: int,
        *,
        generator: torch.Generator,
        progress: Callable[[int], None] | None = None,
        workers: Workers | None = None,
    ) -> TensorDictBase:
        options: dict[str, Any] = {"generator": generator, "progress": progress}
        if workers is not None and "workers" in signature(function).parameters:
            options["workers"] = workers
        found = call("env", name, "collect_segments", function, num_segments, length, **options)
        with located(function):
            check_segments(found, f"env {name!r}: collect_segments()", (num_segments, length))
        return cast("TensorDictBase", found)

    return collect


def check_segments(found: Any, what: str, shape: tuple[int, int] | None = None) -> None:
    """Check what somebody else's code gives as segments.

    Args:
        found: TensorDict ``[N, T]`` with ``observation`` and ``action``.
        what: What messages call it.
        shape: N and T; None for any.

    Raises:
        TypeError: If it is no TensorDict.
        ValueError: If its batch size is another, something is missing, or not finite.
    """
    if not isinstance(found, TensorDictBase):
        raise TypeError(f"{what} must give a TensorDict, got a {type(found).__name__}.")
    wanted = "[N, T]" if shape is None else str(list(shape))
    if len(found.batch_size) != 2 or (shape is not None and found.batch_size != shape):
        raise ValueError(
            f"{what} must give segments of batch size {wanted}, got {list(found.batch_size)}."
        )
    missing = [key for key in (OBSERVATION, ACTION) if key not in found.keys()]  # noqa: SIM118
    if missing:
        raise ValueError(
            f"{what} must give {OBSERVATION} and {ACTION}, got {sorted(map(str, found.keys()))}."
        )
    bad = _not_finite(found)
    if bad:
        raise ValueError(f"{what} must give finite numbers, but has NaN or infinite ones in {bad}.")
    for key in () if INFO not in found.keys() else found[INFO].keys(True, True):  # noqa: SIM118
        if found[INFO, key].shape[:2] != found.batch_size:
            raise ValueError(f"{what} must give infos of every step, got {key!r} of another shape.")


def _not_finite(data: TensorDictBase) -> list[Any]:
    """Keys whose numbers are not all finite."""
    return [key for key in data.keys(True, True) if not _all_finite(data[key])]


def _all_finite(value: Any) -> bool:
    return not isinstance(value, Tensor) or bool(value.isfinite().all())


def _described(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {list(value.shape)}"
    return f"a {type(value).__name__}"
