"""Environments of any spaces, as learners take them: flat numbers seen, one choice or vector done.

Observations of any space that Gymnasium can flatten become one vector of float32: numbers stay, a
choice becomes a one-hot code, parts of a ``Dict`` or ``Tuple`` follow each other in the space's own
order; text is left out. ``observation_names`` tells what is where. Actions of ``MultiDiscrete`` or
``MultiBinary`` spaces are numbered as ``numpy.ravel_multi_index`` does, those of a ``Box`` of any
shape become one vector.
"""

import itertools
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.wrappers import (
    FilterObservation,
    FlattenObservation,
    TransformAction,
    TransformObservation,
)
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from popl_rl.data.behaviours import Behaviour

__all__ = [
    "Native",
    "adapt_behaviour",
    "adapted",
    "as_gymnasium",
    "is_image",
    "native_spaces",
    "observation_names",
]

_MOST = 1024  # combinations of a MultiDiscrete or MultiBinary action at most
_numbers = itertools.count()


class Native(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Remembers the spaces of the environment below, before they are adapted."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.native_spaces = env.observation_space, env.action_space


class _Scalars(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Rewards and ends of TorchRL's environments, arrays of one, as plain numbers."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        over = (bool(np.asarray(end).any()) for end in (terminated, truncated))
        return observation, float(np.asarray(reward).sum()), *over, info


def as_gymnasium(env: Any) -> Any:
    """A TorchRL environment as Gymnasium knows it, by TorchRL's own wrapper; others as they are.

    Raises:
        ValueError: If it is a batch of environments.
    """
    if not isinstance(env, EnvBase):
        return env
    if env.batch_size:
        raise ValueError(
            f"a TorchRL environment must have no batch size, got {list(env.batch_size)}; give one "
            "environment, of which as many are made as are needed"
        )
    name = f"popl_rl/{type(env).__name__}{next(_numbers)}-v0"
    type(env).register_gym(
        name, entry_point=lambda: env, to_numpy=True, backend="gymnasium", order_enforce=False
    )
    try:
        made = gymnasium.make(name, disable_env_checker=True)
    finally:
        gymnasium.registry.pop(name, None)
    return _Scalars(made)


def adapted(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """The environment with flat observations of float32 and ``Discrete`` or flat ``Box`` actions.

    Raises:
        TypeError: If its observations cannot be flattened, or its actions are of another kind.
        ValueError: If there are more combinations of actions than a policy can choose from.
    """
    return _with_flat_actions(_with_flat_observations(Native(env)))


def native_spaces(env: gymnasium.Env[Any, Any]) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """Spaces of observations and actions as they were before ``adapted``."""
    if not env.has_wrapper_attr("native_spaces"):
        return env.observation_space, env.action_space
    return cast(
        "tuple[spaces.Space[Any], spaces.Space[Any]]", env.get_wrapper_attr("native_spaces")
    )


def is_image(space: spaces.Space[Any]) -> bool:
    """Whether a space is of pixels, ``[H, W, C]`` or ``[C, H, W]`` with 3 pixels or more a side."""
    shape = space.shape if isinstance(space, spaces.Box) else None
    return shape is not None and len(shape) == 3 and sorted(shape)[1] >= 3


def _with_flat_observations(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    space = env.observation_space
    if isinstance(space, spaces.Dict) and any(_is_text(part) for part in space.values()):
        kept = [name for name, part in space.items() if not _is_text(part)]
        env = FilterObservation(env, kept)
        space = env.observation_space
    if not space.is_np_flattenable:
        raise TypeError(
            f"observations must be numbers that can be flattened, got {space}; wrap the "
            "environment in gymnasium.wrappers.TransformObservation"
        )
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        env = FlattenObservation(env)
    return env if env.observation_space.dtype == np.float32 else _with_float32(env)


def _with_float32(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    # Gymnasium's DtypeObservation would warn of bounds that lose digits.
    wide = cast("spaces.Box", env.observation_space)
    with np.errstate(over="ignore"):
        low, high = wide.low.astype(np.float32), wide.high.astype(np.float32)
    space = spaces.Box(low, high, dtype=np.float32)
    return TransformObservation(env, lambda seen: np.asarray(seen, np.float32), space)


def _with_flat_actions(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    space = env.action_space
    if isinstance(space, spaces.Discrete):
        return env
    if isinstance(space, spaces.Box):
        if len(space.shape) == 1:
            return env
        flat = spaces.Box(space.low.ravel(), space.high.ravel(), dtype=space.dtype.type)
        return TransformAction(env, lambda action: np.reshape(action, space.shape), flat)
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        sizes, first = _choices(space)
        count = int(np.prod(sizes))
        if count > _MOST:
            raise ValueError(
                f"actions may be at most {_MOST} combinations, got {count} of {space}; leave "
                "choices out with gymnasium.wrappers.TransformAction"
            )

        def choose(number: Any) -> Any:
            parts = np.array(np.unravel_index(int(number), sizes)).reshape(space.shape)
            return (parts + first).astype(space.dtype)

        return TransformAction(env, choose, spaces.Discrete(count))
    raise TypeError(
        f"action_space must be Discrete, MultiDiscrete, MultiBinary or Box, got {space}; wrap the "
        "environment in gymnasium.wrappers.TransformAction"
    )


def adapt_behaviour(behaviour: Behaviour, action_space: gymnasium.Space[Any]) -> Behaviour:
    """A behaviour that gives actions as a space has them, giving them as ``adapted`` does.

    Args:
        behaviour: Maps a TensorDict ``[B]`` and a generator to actions ``[B, ...]``.
        action_space: The space before it was adapted.
    """
    if isinstance(action_space, spaces.Box) and len(action_space.shape) != 1:
        return _Adapted(behaviour, lambda action: action.reshape(len(action), -1))
    if isinstance(action_space, spaces.MultiDiscrete | spaces.MultiBinary):
        sizes, first = _choices(action_space)

        def number(action: Tensor) -> Tensor:
            parts = (action.numpy() - first).reshape(len(action), -1).astype(np.int64)
            return torch.from_numpy(np.asarray(np.ravel_multi_index(tuple(parts.T), sizes)))

        return _Adapted(behaviour, number)
    return behaviour


class _Adapted:
    """A behaviour whose actions are translated."""

    def __init__(self, behaviour: Behaviour, translate: Any) -> None:
        self.behaviour, self.translate = behaviour, translate

    def reset(self) -> None:
        """Begin episodes, if the behaviour wants to know."""
        reset = getattr(self.behaviour, "reset", None)
        if reset is not None:
            reset()

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        return cast("Tensor", self.translate(self.behaviour(step, generator)))


def observation_names(space: spaces.Space[Any]) -> list[str]:
    """What each number of an adapted observation is, such as ``pose[0]`` or ``door=1``.

    Args:
        space: The space before it was adapted.
    """
    return [name.removeprefix(".") or "observation" for name in _names(space, "")]


def _names(space: spaces.Space[Any], name: str) -> list[str]:
    if isinstance(space, spaces.Dict):
        parts = [(f"{name}.{key}", part) for key, part in space.items() if not _is_text(part)]
        return [one for inner, part in parts for one in _names(part, inner)]
    if isinstance(space, spaces.Tuple):
        return [one for i, part in enumerate(space) for one in _names(part, f"{name}.{i}")]
    if isinstance(space, spaces.Discrete):
        return [f"{name}={int(space.start) + value}" for value in range(int(space.n))]
    if isinstance(space, spaces.MultiDiscrete):
        sizes, first = _choices(space)
        return [
            f"{name}[{i}]={begin + value}"
            for i, (size, begin) in enumerate(zip(sizes, np.ravel(first), strict=True))
            for value in range(size)
        ]
    shape = space.shape or ()
    return [
        name + (f"[{','.join(map(str, index))}]" if index else "") for index in np.ndindex(shape)
    ]


def _choices(space: Any) -> tuple[tuple[int, ...], Any]:
    """How many values each of several choices has, and the first of each."""
    if isinstance(space, spaces.MultiBinary):
        return (2,) * int(np.prod(space.shape)), 0
    return tuple(int(size) for size in space.nvec.ravel()), space.start


def _is_text(space: spaces.Space[Any]) -> bool:
    """Whether a space is of words, such as Minigrid's missions."""
    return isinstance(space, spaces.Text) or type(space).__name__ == "MissionSpace"
