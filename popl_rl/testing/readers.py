"""The check of a reader of other people's data."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl import registry
from popl_rl.data.behaviours import first_action
from popl_rl.data.saved import check_preferences
from popl_rl.keys import ACTION, ANSWER, INFO, LEARNER_KEYS, OBSERVATION, RATER, Answer
from popl_rl.plug_ins import call
from popl_rl.testing.plug_ins import Env, EnvReference, identical, made_env, name_of

__all__ = ["check_reader"]


def check_reader(
    reader: str | Callable[[Path], Any],
    path: Path | str,
    env: EnvReference | None = None,
    **arguments: Any,
) -> None:
    """Check that a reader gives segments and preferences; the first fault found is raised.

    Args:
        reader: A function from a path to segments ``[N, T]`` and preferences ``[M]``, or a
            reference to one; see ``popl_rl.keys`` for what they hold.
        path: What it reads.
        env: Where policies will act, as in ``popl_rl.testing.check_env``: observations and actions
            must be of its spaces. None leaves that out.
        **arguments: Keyword arguments for the environment's factory.

    Raises:
        TypeError: If what is read is of another kind or dtype than expected.
        ValueError: If there is nothing at ``path``, the reader fails, what is read has other keys
            or shapes, is not finite, lies outside the environment's spaces, compares segments that
            there are not or with themselves, holds no strict answer, or differs when it is read
            again.
    """
    name = name_of(reader)
    read = registry.resolve("reader", reader) if isinstance(reader, str) else reader
    path = Path(path)
    if not path.exists():
        raise ValueError(f"there is nothing at {path} for reader {name!r} to read; name a file.")
    found = call("reader", name, f"reading {path}", read, path)
    if not isinstance(found, tuple) or len(found) != 2:
        got = f"{len(found)} values" if isinstance(found, tuple) else f"a {type(found).__name__}"
        raise TypeError(f"reader {name!r} must return (segments, preferences), got {got}.")
    segments, preferences = found
    for what, value, size in (("segments", segments, 2), ("preferences", preferences, 1)):
        if not isinstance(value, TensorDictBase):
            raise TypeError(
                f"reader {name!r}: {what} must be a TensorDict, got a {type(value).__name__}."
            )
        if value.batch_dims != size:
            wanted = "[N, T]" if size == 2 else "[M]"
            raise ValueError(
                f"reader {name!r}: {what} must have the batch size {wanted}, got "
                f"{list(value.batch_size)}; give it as the TensorDict's second argument."
            )
    _check_segments(name, segments)
    _check_preferences(name, preferences, path, num_segments=len(segments))
    if env is not None:
        with made_env(name_of(env), env, arguments) as made:
            _check_spaces(name, segments, made)
    for one, again in zip(found, call("reader", name, "reading again", read, path), strict=True):
        if not identical(one, again):
            raise ValueError(
                f"reader {name!r} must read the same each time, but a second time differed; sort "
                "what it lists, and draw nothing at random."
            )


def _require(name: str, what: str, data: TensorDictBase, keys: tuple[Any, ...]) -> None:
    missing = [key for key in keys if key not in data.keys()]  # noqa: SIM118 - not a dict
    if missing:
        raise ValueError(
            f"reader {name!r}: {what} must hold {', '.join(map(str, keys))}, but have no "
            f"{', '.join(map(str, missing))}; they hold {sorted(map(str, data.keys()))}."
        )


def _check_segments(name: str, segments: TensorDictBase) -> None:
    _require(name, "segments", segments, (OBSERVATION, ACTION))
    observation: Tensor = segments[OBSERVATION]
    if observation.ndim != 3 or observation.dtype != torch.float32:
        raise TypeError(
            f"reader {name!r}: observations must be float32 [N, T, O], got {observation.dtype} of "
            f"shape {list(observation.shape)}; use .float(), and flatten what one step shows."
        )
    action: Tensor = segments[ACTION]
    discrete = action.dtype == torch.int64 and action.ndim == 2
    if not discrete and not (action.dtype == torch.float32 and action.ndim == 3):
        raise TypeError(
            f"reader {name!r}: actions must be int64 [N, T] or float32 [N, T, A], got "
            f"{action.dtype} of shape {list(action.shape)}."
        )
    if len(segments) < 2:
        raise ValueError(
            f"reader {name!r}: there must be at least 2 segments, to compare, got {len(segments)}."
        )
    for key in segments.keys(True, True):
        value: Tensor = segments[key]
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(
                f"reader {name!r}: {key} of segments must be finite, got "
                f"{int((~value.isfinite()).sum())} numbers that are not; leave these segments out."
            )
    info = segments.get(INFO, None)
    for key in () if info is None else info.keys(True, True):
        if info[key].shape != segments.shape:
            raise ValueError(
                f"reader {name!r}: info {key!r} must be a number for each step, "
                f"{list(segments.shape)}, got shape {list(info[key].shape)}."
            )


def _check_preferences(
    name: str, preferences: TensorDict, path: Path, *, num_segments: int
) -> None:
    _require(name, "preferences", preferences, LEARNER_KEYS)
    for key in (ANSWER, RATER):
        value: Tensor = preferences[key]
        if value.dtype != torch.int64 or value.ndim != 1:
            raise TypeError(
                f"reader {name!r}: {key} of preferences must be int64 [M], got {value.dtype} of "
                f"shape {list(value.shape)}; use .long()."
            )
    try:
        check_preferences(preferences, path, num_segments=num_segments)
    except ValueError as error:
        raise ValueError(f"reader {name!r}: {error}") from error
    if not bool((preferences[ANSWER] <= Answer.SECOND).any()):
        raise ValueError(
            f"reader {name!r}: preferences must hold a strict answer, 0 (first) or 1 (second), got "
            f"{len(preferences)} ties (2) and skips (3) alone."
        )


def _check_spaces(name: str, segments: TensorDictBase, env: Env) -> None:
    """Check that observations and actions are of the environment's spaces."""
    observation, action = segments[OBSERVATION], segments[ACTION]
    if observation.shape[2:] != env.observation_space.shape:
        raise ValueError(
            f"reader {name!r}: observations must be as the environment's, "
            f"{list(env.observation_space.shape or ())} a step, got {list(observation.shape[2:])}."
        )
    space = env.action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        first = first_action(space)
        last = first + int(space.n) - 1
        if action.ndim != 2 or action.min() < first or action.max() > last:
            raise ValueError(
                f"reader {name!r}: actions must be the environment's, whole numbers {first}..{last}"
                f", got {action.dtype} of shape {list(action.shape)} from {action.min():g} to "
                f"{action.max():g}."
            )
    elif action.shape[2:] != space.shape:
        raise ValueError(
            f"reader {name!r}: actions must be as the environment's, {list(space.shape or ())} a "
            f"step, got {list(action.shape[2:])}."
        )
