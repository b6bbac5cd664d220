"""The check of a rater's function."""

import warnings
from typing import Any

import torch

from popl_rl import registry
from popl_rl.data.environments import offered
from popl_rl.raters.groups import RaterGroup, Utility
from popl_rl.raters.response import Response
from popl_rl.testing.plug_ins import (
    EnvReference,
    identical,
    made_env,
    name_of,
    random_segments,
)
from popl_rl.testing.tiny import tiny_env

__all__ = ["check_rater"]


def check_rater(
    rater: str | Utility, env: EnvReference | None = None, *, seed: int = 0, **arguments: Any
) -> None:
    """Check that a rater's function fits an environment; the first fault found is raised.

    Args:
        rater: A function from segments ``[B, T]`` to utilities ``[B, T]``, or a reference to one.
        env: Where segments come from, as in ``check_env``. None takes ``tiny_env``.
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
    name = name_of(rater)
    function = registry.resolve("rater", rater) if isinstance(rater, str) else rater
    group = RaterGroup(name, function, Response())
    source = tiny_env if env is None else env
    with made_env(name_of(source), source, arguments) as made:
        segments = random_segments(made, seed)
        list_table = offered(made, "transition_table")
        table = list_table() if list_table else None
    before = segments.clone()
    whole = group.step_utility(segments)
    if not identical(before, segments):
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
