"""The check of a selection rule."""

import warnings
from typing import Any

import torch
from torch import Tensor

from popl_rl import registry
from popl_rl.plug_ins import call
from popl_rl.selection.lexicase import lexicase_selection
from popl_rl.selection.rules import SELECTIONS, Selection
from popl_rl.testing.plug_ins import name_of

__all__ = ["check_selection"]

_COUNT = 64  # parents that are drawn: enough that two random draws differ


def check_selection(selection: str | Selection, *, seed: int = 0, **arguments: Any) -> None:
    """Check that a selection rule chooses parents; the first fault found is raised.

    It is tried on random values, on values of which many are equal, on a single member, a single
    case, and fewer parents than members.

    Args:
        selection: A function ``(values [member, case], count, *, generator) -> parents [count]``, a
            reference to one, or the name of one that is built in.
        seed: Seed of the values and of the generator.
        **arguments: Further keyword arguments of the rule.

    Raises:
        TypeError: If the result is no tensor of int64.
        ValueError: If the rule fails, the result has the wrong shape or names members that there
            are not, differs between two generators of one seed, or the rule changes the values or
            draws from torch's global generator.

    Warns:
        UserWarning: If the worst member on every case becomes a parent and the best one never does:
            higher values are better.

    Example:
        >>> from popl_rl.testing import check_selection
        >>> check_selection("tournament", size=2)
    """
    name = name_of(selection)
    rule = _resolved(selection) if isinstance(selection, str) else selection
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(9, 5, generator=generator)
    situations = {
        "random values": (random, _COUNT),
        "values of which many are equal": ((random * 2).round() / 2, _COUNT),
        "one member": (random[:1], 3),
        "one case": (random[:, :1], _COUNT),
        "fewer parents than members": (random, 1),
        "float64 values": (random.double(), _COUNT),
    }
    for situation, (values, count) in situations.items():
        _check_parents(name, rule, situation, values, count, seed=seed, arguments=arguments)
    ordered = torch.tensor([0.0, 0.5, 1.0]).unsqueeze(1).expand(3, 5).contiguous()
    chosen = rule(ordered, 200, generator=torch.Generator().manual_seed(seed), **arguments).tolist()
    if 0 in chosen and 2 not in chosen:
        warnings.warn(
            f"selection {name!r} takes the member that is worst on every case and never the one "
            "that is best; higher values are better.",
            stacklevel=2,
        )


def _resolved(reference: str) -> Any:
    built_in = {"lexicase": lexicase_selection, **SELECTIONS}
    return built_in.get(reference) or registry.resolve("selection", reference)


def _check_parents(
    name: str,
    rule: Selection,
    situation: str,
    values: Tensor,
    count: int,
    *,
    seed: int,
    arguments: dict[str, Any],
) -> None:
    """Check what a rule chooses in one situation."""

    def select(doing: str) -> Any:
        own = torch.Generator().manual_seed(seed)
        return call("selection", name, doing, rule, values, count, generator=own, **arguments)

    before, state = values.clone(), torch.random.get_rng_state()
    parents = select(f"selecting {count} of {situation}, shape {list(values.shape)},")
    if not torch.equal(state, torch.random.get_rng_state()):
        raise ValueError(
            f"selection {name!r} must draw from the generator that it is given, but drew from "
            "torch's global one; pass generator=generator to torch.rand, randint and the like."
        )
    if not torch.equal(before, values):
        raise ValueError(
            f"selection {name!r} must leave values as they are, but changed them; work on a copy, "
            "as in values.clone(), and use operations without a trailing underscore."
        )
    if not isinstance(parents, Tensor) or parents.dtype != torch.int64:
        kind = getattr(parents, "dtype", type(parents).__name__)
        raise TypeError(
            f"selection {name!r} must return a tensor of int64, one row of values for each parent, "
            f"got {kind}; use torch.tensor(parents) or .long()."
        )
    if parents.shape != (count,):
        raise ValueError(
            f"selection {name!r} must return [{count}] parents of {situation}, got shape "
            f"{list(parents.shape)}; a member may be selected more than once."
        )
    if parents.min() < 0 or parents.max() >= len(values):
        raise ValueError(
            f"selection {name!r} must return rows of values, 0..{len(values) - 1} for {situation}, "
            f"got {int(parents.min())}..{int(parents.max())}; values are [member, case]."
        )
    if not torch.equal(parents, select("a second selection")):
        raise ValueError(
            f"selection {name!r} must choose the same parents from one seed, but two calls "
            f"differed on {situation}; take all randomness from the generator, and keep no state."
        )
