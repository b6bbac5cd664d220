"""What all figures of a benchmark share: colours and markers of methods, places on an axis."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from popl_rl.evaluation.suite import Suite
from popl_rl.plotting.style import PALETTE

__all__ = ["BASELINE_COLOURS", "axis_positions", "method_columns", "method_styles"]


_COLOURS = tuple(PALETTE[name] for name in ("blue", "vermilion", "green", "purple", "sky"))


_MARKERS = ("o", "s", "^", "D", "v")


BASELINE_COLOURS = {
    "cpl": PALETTE["orange"],
    "bradley_terry": PALETTE["orange"],
    "oracle": PALETTE["black"],
}


def method_styles(suite: Suite, methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each method: a suite's own have the same in all of its figures."""
    free = ((colour, marker) for marker, colour in itertools.product(_MARKERS, _COLOURS))
    found = dict(zip(suite.methods, free, strict=False))
    for name in methods:
        if name in BASELINE_COLOURS:
            found[name] = (BASELINE_COLOURS[name], "x")
        elif name not in found:
            base = name.removesuffix("_lexicase")
            found[name] = found[base] if base in found else next(free)
    return found


def method_columns(fig: Figure) -> int:
    """Entries of a legend that fit beside each other."""
    return max(1, int(fig.get_figwidth() / 2.8))


def axis_positions(values: Sequence[float | str]) -> NDArray[np.float64]:
    """Places on a linear axis: logarithms of values that differ fivefold, steps for words."""
    if any(isinstance(value, str) for value in values):
        return np.arange(len(values), dtype=float)
    numbers = np.array(values, dtype=float)
    if numbers.min() > 0 and numbers.max() >= 5 * numbers.min():
        numbers = np.log10(numbers)
    return numbers
