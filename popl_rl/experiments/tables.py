"""Tables of results in READMEs, written from committed rows of benchmarks."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from popl_rl.evaluation.statistics import differs_from_zero, interval, require_columns
from popl_rl.experiments.cells import COLUMNS
from popl_rl.experiments.markdown import markdown_table
from popl_rl.experiments.table_rows import (
    Entry,
    Over,
    column_pairs,
    difference,
    difference_text,
    number_text,
    rows_of_methods,
    values_by_seed,
)
from popl_rl.experiments.wins_table import WinsTable

__all__ = [
    "COLUMNS",
    "PeopleTable",
    "ResultTable",
    "WinsTable",
    "fill_tables",
    "make_tables",
    "read_tables",
    "rows_for",
]

_MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class ResultTable:
    """One measure of methods (rows) in scenarios (columns), or the other way round.

    Attributes:
        suite: The suite whose rows it shows.
        measure: The measure, as in ``results.csv``.
        methods: ``(method, choice)`` -> what the row is called.
        scenarios: Scenario -> what the column is called.
        over: Of which group: the one served ``"worst"``, the ``"mean"`` over groups, or ``"all"``,
            for measures of all groups together.
        against: Method and choice that the others are subtracted from, seed by seed; None to show
            them as they are.
        transposed: Whether scenarios are rows, and methods columns: for many scenarios.
    """

    suite: str
    measure: str
    methods: Mapping[Entry, str]
    scenarios: Mapping[str, str]
    over: Over = "worst"
    against: Entry | None = None
    transposed: bool = False

    def rows(self, results: pd.DataFrame) -> pd.DataFrame:
        """Rows that the table is made from.

        Args:
            results: Rows with the columns ``COLUMNS``.

        Returns:
            Those of its suite, measure, scenarios and methods, one for each group.

        Raises:
            ValueError: If ``results`` lacks a column.
        """
        methods = [*self.methods, *([] if self.against is None else [self.against])]
        rows = rows_of_methods(results, self.suite, methods)
        return rows[
            (rows["measure"] == self.measure)
            & ((rows["group"] == "all") == (self.over == "all"))
            & rows["scenario"].isin(list(self.scenarios))
        ]

    def markdown(self, results: pd.DataFrame) -> str:
        """Lay the table out.

        Args:
            results: Rows with the columns ``COLUMNS``.

        Returns:
            The table; a cell is mean ± 95 % interval over seeds [lowest], without an interval below
            three seeds, one seed's value alone, or – without rows. With ``against``, mean of the
            differences ± 95 % interval, and an asterisk where it is not 0 at a level of 5 % for all
            cells together (Holm, 1979; t-tests paired over seeds).

        Raises:
            ValueError: If ``results`` lacks a column.
        """
        value = values_by_seed(self.rows(results), self.over)
        places = [(entry, scenario) for entry in self.methods for scenario in self.scenarios]
        cells = dict(zip(places, self._cells(value, places), strict=True))
        grid = [[cells[entry, scenario] for scenario in self.scenarios] for entry in self.methods]
        corner, down, across = "method", self.methods.values(), self.scenarios.values()
        if self.transposed:
            grid = [list(column) for column in zip(*grid, strict=True)]
            corner, down, across = "scenario", across, down
        lines = [[label, *line] for label, line in zip(down, grid, strict=True)]
        return markdown_table([corner, *across], lines, right=len(across))

    def _cells(
        self,
        value: Mapping[tuple[Entry, str], dict[int, float]],
        places: Sequence[tuple[Entry, str]],
    ) -> list[str]:
        """A cell for each method and scenario, from a value for each seed."""
        if self.against is None:
            return [_cell(list(value.get(place, {}).values())) for place in places]
        pairs = [
            difference(value.get(place, {}), value.get((self.against, place[1]), {}))
            for place in places
        ]
        return [
            difference_text(one) + "*" * sure
            for one, sure in zip(pairs, differs_from_zero(pairs), strict=True)
        ]


@dataclass(frozen=True)
class PeopleTable:
    """Measures of methods on real people: rows are methods, columns groups and measures.

    Attributes:
        suite: The study whose rows it shows.
        methods: ``(method, choice)`` -> what the row is called.
        columns: ``(group, measure)`` -> what the column is called.
    """

    suite: str
    methods: Mapping[tuple[str, str], str]
    columns: Mapping[tuple[str, str], str]

    def rows(self, results: pd.DataFrame) -> pd.DataFrame:
        """Rows that the table is made from, with the ends of their intervals.

        Args:
            results: Rows with the columns `COLUMNS`.

        Raises:
            ValueError: If ``results`` lacks a column.
        """
        rows = rows_of_methods(results, self.suite, self.methods)
        wanted = {(g, name) for g, measure in self.columns for name in _with_ends(measure)}
        return rows[column_pairs(rows, "group", "measure").isin(list(wanted))]

    def markdown(self, results: pd.DataFrame) -> str:
        """Lay the table out.

        Args:
            results: Rows with the columns `COLUMNS`.

        Returns:
            The table; a cell is a mean over people [95 % interval], or – without rows.

        Raises:
            ValueError: If ``results`` lacks a column.
        """
        key = ["method", "choice", "group", "measure"]
        value = self.rows(results).groupby(key)["value"].mean().to_dict()
        lines = []
        for (method, choice), label in self.methods.items():
            cells = []
            for group, measure in self.columns:
                found = [value.get((method, choice, group, n)) for n in _with_ends(measure)]
                cells.append(_mean_and_ends(found))
            lines.append([label, *cells])
        return markdown_table(["method", *self.columns.values()], lines, right=len(self.columns))


def _with_ends(measure: str) -> tuple[str, str, str]:
    name, at, answers = measure.partition("@")
    return measure, f"{name}_low{at}{answers}", f"{name}_high{at}{answers}"


def _mean_and_ends(found: Sequence[float | None]) -> str:
    mean, low, high = found
    if mean is None or mean != mean:
        return "–"
    text = f"{mean + 0.0:.3f}"
    if low is not None and high is not None and low == low:
        text += f" [{low + 0.0:.3f}, {high + 0.0:.3f}]"
    return text.replace("-", "−")


Table = ResultTable | WinsTable | PeopleTable


def read_tables(path: Path) -> dict[str, Table]:
    """Read which tables there are.

    Args:
        path: A TOML file with a section for each table: ``suite``, ``measure``, ``methods`` (a list
            of ``[method, choice, label]``) and ``scenarios`` (name = title); or, of real people,
            ``columns`` (a list of ``[group, measure, title]``) in the place of ``measure`` and
            ``scenarios``. ``over``, ``against`` and ``transposed`` as in `ResultTable`. With
            ``wins_of = [method, choice]`` and a list ``measures`` it is a `WinsTable`.

    Returns:
        The tables by name.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no TOML, or a table is not described like that.
    """
    tables: dict[str, Table] = {}
    for name, about in tomllib.loads(path.read_text(encoding="utf-8")).items():
        try:
            tables[name] = _table(about)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"table {name!r} in {path} must have suite, measure, methods as a list of [method, "
                f"choice, label], and scenarios, got {about!r}; correct or remove it"
            ) from error
    return tables


def _table(about: Mapping[str, Any]) -> Table:
    """The table that a section describes."""
    methods = {(method, choice): label for method, choice, label in about["methods"]}
    if "columns" in about:
        columns = {(group, measure): title for group, measure, title in about["columns"]}
        return PeopleTable(about["suite"], methods, columns)
    scenarios, over = about["scenarios"], about.get("over", "worst")
    if "wins_of" in about:
        method, choice = about["wins_of"]
        return WinsTable(
            about["suite"], about["measures"], (method, choice), methods, scenarios, over
        )
    against: Entry | None = None
    if "against" in about:
        method, choice = about["against"]
        against = (method, choice)
    shown = about["suite"], about["measure"], methods, scenarios, over, against
    return ResultTable(*shown, transposed=about.get("transposed", False))


def rows_for(tables: Mapping[str, Table], results: pd.DataFrame) -> pd.DataFrame:
    """Keep of a benchmark's rows what its tables need, in their order.

    Args:
        tables: Tables by name.
        results: Rows with the columns ``COLUMNS``.

    Returns:
        Rows with these columns alone.

    Raises:
        ValueError: If ``results`` lacks a column.
    """
    require_columns(results, COLUMNS)
    needed = [index for table in tables.values() for index in table.rows(results).index]
    return results.loc[sorted(set(needed)), COLUMNS]


def make_tables(tables: Mapping[str, Table], folder: Path) -> dict[str, str]:
    """Lay out all tables from the rows in a folder.

    Args:
        tables: Tables by name.
        folder: Where ``<suite>.csv`` are; a suite without one has not been run.

    Returns:
        Markdown by name of the table.

    Raises:
        ValueError: If a file lacks a column.
    """
    nothing = pd.DataFrame(columns=COLUMNS)
    rows = {
        table.suite: pd.read_csv(path) if path.is_file() else nothing
        for table in tables.values()
        for path in [folder / f"{table.suite}.csv"]
    }
    return {name: table.markdown(rows[table.suite]) for name, table in tables.items()}


def fill_tables(text: str, tables: Mapping[str, str]) -> str:
    """Replace what stands between ``<!-- table: NAME -->`` and ``<!-- end -->``.

    Args:
        text: A Markdown file.
        tables: Markdown of each table, by name.

    Returns:
        The text with these tables.

    Raises:
        ValueError: If the text asks for a table that is not in ``tables``.
    """
    unknown = sorted({match[2] for match in _MARKED.finditer(text)} - set(tables))
    if unknown:
        raise ValueError(
            f"the text must name tables among {sorted(tables)}, got {unknown}; correct the name "
            "after '<!-- table:' or describe the table"
        )
    return _MARKED.sub(lambda match: f"{match[1]}{tables[match[2]]}\n{match[3]}", text)


def _cell(values: Sequence[float]) -> str:
    if not values:
        return "–"
    mean, half = interval(values)
    # Of two seeds it is 13 standard errors wide, and says nothing.
    spread = f" ± {half:.2f}" if len(values) > 2 else ""
    lowest = f" [{number_text(min(values))}]" if len(values) > 1 else ""
    return f"{number_text(mean)}{spread}{lowest}"
