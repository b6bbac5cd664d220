"""The check of a frozen feature extractor."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from popl_rl import registry
from popl_rl.data.environments import offered
from popl_rl.data.features import Extractor, frozen
from popl_rl.plug_ins import call
from popl_rl.testing.plug_ins import Env, EnvReference, made_env, name_of

__all__ = ["check_features"]

_COUNT = 16  # observations that are read


def check_features(
    features: str | Extractor, env: EnvReference, *, seed: int = 0, **arguments: Any
) -> None:
    """Check that an extractor reads what an environment shows; the first fault found is raised.

    Args:
        features: A ``torch.nn.Module``, what makes one, a function of what is shown, or a reference
            to one of these; see ``popl_rl.data.features.extractor``.
        env: Whose observations are read, as in ``popl_rl.testing.check_env``.
        seed: Seed of the random actions.
        **arguments: Keyword arguments for the environment's factory.

    Raises:
        TypeError: If it is none of these, what it gives back is no tensor ``[B, F]``, or the
            environment's observations are no ``Box``.
        ValueError: If making it or reading with it fails, features are none or not finite, change
            from call to call, with the other observations of the batch or where it is made anew,
            hold gradients, if it changes what it is given, or if the environment collects segments
            itself.

    Warns:
        UserWarning: If observations that differ all have the same features.

    Example:
        >>> from popl_rl.testing import check_features, tiny_env
        >>> check_features(lambda shown: shown * 2, tiny_env)
    """
    name = name_of(features)
    found = registry.resolve("features", features) if isinstance(features, str) else features
    extract = frozen(name, found)
    with made_env(name_of(env), env, arguments, flat=False) as made:
        shown = _observations(name_of(env), made, seed)
    before = shown.clone()
    read = extract(shown)
    if not torch.equal(before, shown):
        raise ValueError(
            f"features {name!r} must leave observations as they are, but changed them; work on a "
            "copy, as in observations.clone(), and use operations without a trailing underscore."
        )
    if read.requires_grad:
        raise ValueError(
            f"features {name!r} must be read without gradients, but asked for them; leave out "
            "torch.enable_grad(), or return features.detach()."
        )
    if read.shape[1] == 0 or not bool(read.isfinite().all()):
        got = "none" if read.shape[1] == 0 else "values that are not"
        raise ValueError(
            f"features {name!r} must be one or more finite numbers for an observation, got {got}."
        )
    if not torch.equal(read, extract(shown)):
        raise ValueError(
            f"features {name!r} must be the same each time, but a second call differed; draw "
            "nothing at random, keep no state, and put modules into eval()."
        )
    alone = torch.cat([_alone(name, extract, one, read.shape[1]) for one in shown.split(1)])
    if not torch.allclose(alone, read, rtol=1e-4, atol=1e-5):
        raise ValueError(
            f"features {name!r} must read each observation by itself, but some came out "
            "differently alone; do not normalise by the rest of the batch."
        )
    if not torch.equal(read, frozen(name, found)(shown)):
        raise ValueError(
            f"features {name!r} must be the same in every process, but differ where it is made "
            "anew; load its weights from a file, or draw them from torch's generator alone."
        )
    if len(shown.unique(dim=0)) > 1 and len(read.unique(dim=0)) == 1:
        warnings.warn(
            f"features {name!r} are the same for all {len(shown)} observations, so that nobody "
            "can act on them; look at what it makes of their range and type.",
            stacklevel=2,
        )


def _alone(name: str, extract: Extractor, one: Tensor, size: int) -> Tensor:
    """Features ``[1, F]`` of an observation ``[1, ...]`` alone."""
    read = extract(one)
    if read.shape[1] != size:
        raise ValueError(
            f"features {name!r} must have one length, got {size} for many observations and "
            f"{read.shape[1]} for one alone; keep the first dimension, as in flatten(1)."
        )
    return read


def _observations(name: str, env: Env, seed: int) -> Tensor:
    """What an environment shows while it acts at random, ``[B, ...]`` as its space has it."""
    space = env.observation_space
    if not isinstance(space, gymnasium.spaces.Box):
        raise TypeError(
            f"env {name!r}: features are read of observations that are a Box, got {space}."
        )
    if offered(env, "collect_segments") is not None:
        raise ValueError(
            f"env {name!r} collects segments itself, so that its features are not read; let "
            "collect_segments() and its observations give the features."
        )
    env.action_space.seed(seed)
    over, seen = True, []
    for step in range(_COUNT):
        if over:
            observation, _ = call("env", name, "reset", env.reset, seed=seed + step)
            over = False
        else:
            action = env.action_space.sample()
            observation, _, ended, cut, _ = call("env", name, "step", env.step, action)
            over = bool(ended or cut)
        seen.append(np.array(observation, space.dtype))
    return torch.from_numpy(np.stack(seen))
