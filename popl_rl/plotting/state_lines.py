"""What figures over a line of states share: checks, colours of groups, and room for legends."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from popl_rl.evaluation.ranking_agreement import Array, checked_table
from popl_rl.plotting.style import MEMBER_COLOURS

__all__ = ["curve_of", "cycled", "ends", "legend_shape", "line_of_states", "spaced"]

_MOST = 200  # lines and rows that a figure has room for


def line_of_states(
    states: ArrayLike, truths: Mapping[str, ArrayLike]
) -> tuple[Array, NDArray[np.int64], dict[str, Array]]:
    """Return the states in their order on the line, this order, and the truths in it."""
    at = np.asarray(states, dtype=np.float64)
    if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all():
        raise ValueError(f"states must be at least 2 finite positions [S], got shape {at.shape}")
    if not truths:
        raise ValueError("truths must hold at least one group's utility, got none")
    order = np.argsort(at, kind="stable")
    true = {name: curve_of(f"truths[{name!r}]", curve, at)[order] for name, curve in truths.items()}
    return at[order], order, true


def curve_of(what: str, curve: ArrayLike, at: Array) -> Array:
    """Return a utility of every state, ``[S]``, checked; ``what`` is its name in messages."""
    values: Array = np.asarray(curve, dtype=np.float64)
    if values.shape != at.shape:
        raise ValueError(f"{what} must have shape [{len(at)} states], got {values.shape}")
    checked_table(what, values[None], at)
    return values


def spaced(count: int) -> NDArray[np.int64]:
    """Return evenly spaced indices of at most as many rows as there is room for."""
    return np.linspace(0, count - 1, min(count, _MOST)).round().astype(np.int64)


def legend_shape(
    entries: int, labels: Sequence[str], width: float, *, rows: int = 1
) -> tuple[int, int]:
    """Return columns and rows of a legend with room for long labels below a figure, in inches."""
    fitting = int((width - 0.2) / (0.6 + 0.078 * max(map(len, labels))))
    columns = max(1, min(fitting, math.ceil(entries / rows)))
    return columns, math.ceil(entries / columns)


def cycled(count: int) -> list[str]:
    """Return a colour for each of some groups; they begin again if there are too few."""
    return [MEMBER_COLOURS[index % len(MEMBER_COLOURS)] for index in range(count)]


def ends(at: Array) -> tuple[float, float]:
    """Return the ends of the line of states, for ticks."""
    return round(float(at[0]), 2), round(float(at[-1]), 2)
