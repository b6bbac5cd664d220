"""What all figures of a benchmark share: colours and markers of methods, places on an axis."""

import itertools
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from popl_rl.evaluation.method_names import METHODS, drawn_references
from popl_rl.evaluation.statistics import HEADLINES
from popl_rl.evaluation.suite import Suite
from popl_rl.plotting.style import PALETTE

__all__ = [
    "BASELINE_COLOURS",
    "axis_positions",
    "ends_of_scale",
    "explain_headline",
    "explain_scale",
    "headline_name",
    "method_columns",
    "method_styles",
    "of_single_policies",
]

_COLOURS = tuple(PALETTE[name] for name in ("blue", "vermilion", "green", "purple", "sky"))
_MARKERS = ("o", "s", "^", "D", "v")

BASELINE_COLOURS = {name: PALETTE[METHODS[name].colour] for name in drawn_references()}
"""Colours of what every figure shows beside the methods of a suite."""


def method_styles(suite: Suite, methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each method: a suite's own have the same in all of its figures."""
    free = ((colour, marker) for marker, colour in itertools.product(_MARKERS, _COLOURS))
    found = dict(zip(suite.methods, free, strict=False))
    for name in methods:
        if name in BASELINE_COLOURS:
            found[name] = (BASELINE_COLOURS[name], "x")
        elif name not in found:
            found[name] = next(free)
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


def of_single_policies(suite: Suite, table: pd.DataFrame) -> pd.DataFrame:
    """Rows of a suite's own methods by their headline choice, and of what every figure shows.

    Other ways to cater, and other methods to compare with, are more lines than can be read.
    """
    shown = table["method"].isin([*suite.methods, *BASELINE_COLOURS])
    return table[shown & (table["choice"] != "lexicase")]


def headline_name(table: pd.DataFrame) -> str:
    """Name of what an axis shows; both if scenarios differ in their headline measure.

    Args:
        table: Rows as of ``popl_rl.evaluation.statistics.worst``.
    """
    found = set(table["measure"])
    return ", or ".join(name for measure, name in HEADLINES.items() if measure in found)


def explain_headline(table: pd.DataFrame) -> str:
    """Definition of what an axis shows, for a caption.

    Args:
        table: Rows as of ``popl_rl.evaluation.statistics.worst``.
    """
    if set(table["measure"]) == {"share_of_optimum"}:
        return "Share of optimum: (return − random) / (optimum − random)"
    if set(table["measure"]) == {"recovery"}:
        return "Recovery: (return − floor) / (oracle's return − floor)"
    return "Share of the optimum where it is known, recovery of the oracle's return elsewhere"


def explain_scale(table: pd.DataFrame) -> str:
    """What 1 and 0 are, for the caption of a narrow figure.

    Args:
        table: Rows as of ``popl_rl.evaluation.statistics.worst``.
    """
    if set(table["measure"]) == {"share_of_optimum"}:
        return "Share of optimum: 1 the optimum, 0 random actions"
    return f"{headline_name(table).capitalize()}: 1 as good as the oracle, 0 as the floor"


def ends_of_scale(table: pd.DataFrame) -> tuple[str, str]:
    """What 1 and 0 on an axis mean.

    Args:
        table: Rows as of ``popl_rl.evaluation.statistics.worst``.
    """
    if set(table["measure"]) == {"share_of_optimum"}:
        return "the optimum", "as good as\nrandom actions"
    return "as good as the oracle", "as good as\nthe floor"
