"""Frozen feature extractors, by reference: an image is read once, and learners see its features.

``env.features`` names a ``torch.nn.Module``, what makes one, or a function. An environment that is
wrapped by ``Extracted`` gives features in the place of what it shows, so that segments hold them
and policies act on them; nothing trains the extractor.
"""

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from popl_rl.data.tables import Table
from popl_rl.keys import OBSERVATION
from popl_rl.plug_ins import call, defined
from popl_rl.registry import resolve

__all__ = ["Extracted", "extractor", "feature_source", "frozen", "with_features"]

_BLOCK = 1024  # observations that are read at once

Extractor = Callable[[Tensor], Tensor]


@cache
def extractor(reference: str) -> Extractor:
    """What a reference names, frozen: what is shown ``[B, ...]`` -> features ``[B, F]`` of float32.

    Args:
        reference: ``module:attr`` or ``file.py:attr`` of a module, of a class or function without
            required arguments that makes one (with the same initial weights in every process), or
            of a function of what is shown.

    Returns:
        A function that checks what it is given back.

    Raises:
        ValueError: If the reference cannot be resolved, or making the module fails.
        TypeError: If it makes something other than a module.
    """
    return frozen(reference, resolve("features", reference))


def frozen(name: str, found: Any) -> Extractor:
    """An extractor of which nothing is trained: what is shown ``[B, ...]`` -> ``[B, F]`` float32.

    Args:
        name: What messages call it.
        found: What a reference names, see ``extractor``.

    Raises:
        ValueError: If making the module fails.
        TypeError: If it can make or read nothing.
    """
    if not callable(found):
        raise TypeError(
            f"features {name!r} must be a torch.nn.Module, what makes one, or a function of what "
            f"is shown, got {type(found).__name__}"
        )
    if not isinstance(found, nn.Module) and _makes_one(found):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # untrained weights are the same wherever they are made
            made = call("features", name, "making it", found)
        if not isinstance(made, nn.Module):
            raise TypeError(
                f"features {name!r}: what takes no argument must return a torch.nn.Module, "
                f"got {type(made).__name__} ({defined(found)})"
            )
        found = made
    if isinstance(found, nn.Module):
        found.requires_grad_(False).eval()

    @torch.no_grad()
    def extract(shown: Tensor) -> Tensor:
        given = call("features", name, "reading observations", found, shown)
        is_fitting = isinstance(given, Tensor) and given.ndim > 1 and len(given) == len(shown)
        if not is_fitting or given.is_complex():
            got = list(given.shape) if isinstance(given, Tensor) else type(given).__name__
            raise TypeError(
                f"features {name!r} must return numbers of shape [{len(shown)}, F] for "
                f"observations of shape {list(shown.shape)}, got {got} ({defined(found)})"
            )
        return cast("Tensor", given).flatten(1).float().cpu()

    return extract


class Extracted(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Gives the features of what an environment shows.

    Args:
        env: An environment whose observations are a ``Box``, such as images ``[H, W, C]``.
        reference: See ``extractor``. It is given observations as the environment's space has them,
            ``[1, H, W, C]`` uint8 for images.

    Attributes:
        feature_source: The reference, and the shape of what is shown.
        shown: Space of what is shown.

    Raises:
        TypeError: If observations are no ``Box``, or the extractor returns no features of them.
        ValueError: If the reference cannot be resolved or the extractor fails.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], reference: str) -> None:
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, gymnasium.spaces.Box):
            raise TypeError(f"env.features needs observations that are a Box, got {space}")
        self._extract = extractor(reference)
        self.shown = space
        self.feature_source = reference, tuple(int(length) for length in space.shape)
        size = self.observation(np.zeros(space.shape, space.dtype)).shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)

    def observation(self, observation: Any) -> NDArray[np.float32]:
        """Features of one observation, ``[F]``."""
        shown = np.array(observation, self.shown.dtype)  # a copy, which nothing changes any more
        features: NDArray[np.float32] = self._extract(torch.from_numpy(shown)[None])[0].numpy()
        return features


def feature_source(env: gymnasium.Env[Any, Any]) -> tuple[str, tuple[int, ...]]:
    """Reference of an environment's extractor and shape of what it reads; empty without one."""
    if not env.has_wrapper_attr("feature_source"):
        return "", ()
    return cast("tuple[str, tuple[int, ...]]", env.get_wrapper_attr("feature_source"))


def with_features(table: Table, env: gymnasium.Env[Any, Any]) -> Table:
    """A table of what an environment shows, with the features in the place of that.

    Args:
        table: Of the environment below ``Extracted``, its observations flat, ``[S, A, O]``.
        env: The environment.

    Returns:
        The same table without ``horizon``: features that are looked up may differ in their last
        bits from those of a step, so that environments are stepped.

    Raises:
        ValueError: If the table's observations are of another length.
    """
    reference, shape = feature_source(env)
    listed, space = table.steps[OBSERVATION], env.get_wrapper_attr("shown")
    if listed.shape[2:].numel() != int(np.prod(shape)):
        raise ValueError(
            f"transition_table() must list observations of {list(shape)}, as the environment shows "
            f"them, got {list(listed.shape[2:])}"
        )
    shown = torch.from_numpy(listed.reshape(-1, *shape).numpy().astype(space.dtype))
    read = [extractor(reference)(part) for part in shown.split(_BLOCK)]
    steps = table.steps.copy()
    steps[OBSERVATION] = torch.cat(read).view(*listed.shape[:2], -1)
    return replace(table, steps=steps, horizon=None)


def _makes_one(found: Any) -> bool:
    """Whether something can be called without arguments: a module class, or what makes a module."""
    try:
        inspect.signature(found).bind()
    except (TypeError, ValueError):
        return isinstance(found, type)  # a class that wants arguments says so when it is made
    return True
