"""Wins, ties and losses of one method against others, from committed rows of benchmarks."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from popl_rl.evaluation.statistics import differs_from_zero, interval
from popl_rl.experiments.markdown import markdown_table
from popl_rl.experiments.table_rows import (
    Entry,
    Over,
    difference,
    difference_text,
    rows_of_methods,
    values_by_seed,
)

__all__ = ["WinsTable"]


@dataclass(frozen=True)
class WinsTable:
    """One method minus each other method (rows), scenario by scenario (columns).

    Attributes:
        suite: The suite whose rows it shows.
        measures: Measures, as in ``results.csv``, the preferred one first: a scenario is judged by
            the first of them that it has.
        of: Method and choice that wins or loses.
        methods: ``(method, choice)`` of the others -> what the row is called.
        scenarios: Scenario -> what the column is called.
        over: Of which group, as in ``popl_rl.experiments.tables.ResultTable``.
    """

    suite: str
    measures: Sequence[str]
    of: Entry
    methods: Mapping[Entry, str]
    scenarios: Mapping[str, str]
    over: Over = "worst"

    def rows(self, results: pd.DataFrame) -> pd.DataFrame:
        """Rows that the table is made from.

        Args:
            results: Rows with the columns ``popl_rl.experiments.cells.COLUMNS``.

        Returns:
            Those of its suite, scenarios and methods, of one measure in each scenario and one for
            each group.

        Raises:
            ValueError: If ``results`` lacks a column.
        """
        rows = rows_of_methods(results, self.suite, [self.of, *self.methods])
        rows = rows[
            ((rows["group"] == "all") == (self.over == "all"))
            & rows["scenario"].isin(list(self.scenarios))
            & rows["measure"].isin(list(self.measures))
        ]
        rank = rows["measure"].map({name: rank for rank, name in enumerate(self.measures)})
        return rows[rank == rank.groupby(rows["scenario"]).transform("min")]

    def markdown(self, results: pd.DataFrame) -> str:
        """Lay the table out.

        Args:
            results: Rows with the columns ``popl_rl.experiments.cells.COLUMNS``.

        Returns:
            The table; a cell is the mean of the differences, paired over seeds, ± half of its own
            95 % interval, or – without rows. It is marked ``▲`` (a win) or ``▼`` (a loss) where it
            is not 0 at a level of 5 % for all cells of the table together (t-tests; Holm, 1979);
            all other cells are ties, among which ``△`` and ``▽`` mark those whose own interval is
            apart from 0. The last column counts, without cells of a single seed.

        Raises:
            ValueError: If ``results`` lacks a column.
        """
        value = values_by_seed(self.rows(results), self.over)
        places = [(entry, scenario) for entry in self.methods for scenario in self.scenarios]
        pairs = [
            difference(value.get((self.of, scenario), {}), value.get((entry, scenario), {}))
            for entry, scenario in places
        ]
        marks = [
            _mark(one, sure) for one, sure in zip(pairs, differs_from_zero(pairs), strict=True)
        ]
        cells = [difference_text(one) + mark for one, mark in zip(pairs, marks, strict=True)]
        columns = len(self.scenarios)
        lines = []
        for row, label in enumerate(self.methods.values()):
            own = slice(row * columns, (row + 1) * columns)
            judged = [m for one, m in zip(pairs[own], marks[own], strict=True) if len(one) > 1]
            count = Counter(judged)
            wins, losses = count[_WIN], count[_LOSS]
            tally = f"{wins} / {len(judged) - wins - losses} / {losses}"
            lines.append([label, *cells[own], tally])
        head = ["against", *self.scenarios.values(), "wins / ties / losses"]
        return markdown_table(head, lines, right=columns + 1)


_WIN, _LOSS = " ▲", " ▼"


def _mark(differences: Sequence[float], sure: bool) -> str:
    """What a cell says: a win, a loss, a hint of either, or nothing."""
    if not differences:
        return ""
    mean, half = interval(differences)
    if sure:
        return _WIN if mean > 0 else _LOSS
    if abs(mean) > half:  # false with one seed alone, where half is NaN
        return " △" if mean > 0 else " ▽"
    return ""
