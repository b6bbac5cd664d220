"""What makes no sense in a file, collected with the numbers of its rows."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

__all__ = ["Problems", "listed"]

_SHOWN = 5  # rows, or names, that a message lists


def listed(values: Sequence[object]) -> str:
    """The first few of some values, and how many more there are."""
    shown = ", ".join(str(value) for value in values[:_SHOWN])
    more = len(values) - _SHOWN
    return f"{shown} and {more} more" if more > 0 else shown


class Problems:
    """Collects what is wrong with a file, to tell it all at once.

    Rows are counted as an editor counts lines: the header of a csv file is row 1.

    Args:
        path: The file.
        first: Number of the file's first row of data.
    """

    def __init__(self, path: Path, *, first: int = 1) -> None:
        self.path = path
        self.first = first
        self.found: list[str] = []

    def add(self, where: npt.ArrayLike, text: str, *, start: int = 0) -> None:
        """Report rows, if there are any.

        Args:
            where: A mask over rows ``[M]`` bool.
            text: What is wrong with them, and what would be right.
            start: Number of the mask's first row among the rows of data, counted from 0.
        """
        rows = np.flatnonzero(np.asarray(where, dtype=bool)) + start + self.first
        if len(rows):
            word = "row" if len(rows) == 1 else "rows"
            self.found.append(f"{word} {listed(rows.tolist())}: {text}")

    def add_text(self, text: str) -> None:
        """Report what concerns no row."""
        self.found.append(text)

    def check(self) -> None:
        """Raise if anything was reported.

        Raises:
            ValueError: Naming the file and listing every problem.
        """
        if self.found:
            raise ValueError(f"{self.path} cannot be used:\n  " + "\n  ".join(self.found))
