"""Tables of results in READMEs, written from committed rows of benchmarks."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from popl_rl.evaluation.statistics import interval, require_columns
from popl_rl.experiments.markdown import markdown_table

__all__ = ["ResultTable", "fill_tables"]

_MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class ResultTable:
    """One measure of methods (rows) in scenarios (columns), for the group served worst.

    Args:
        measure: The measure, as in ``results.csv``.
        methods: ``(method, choice)`` -> what the row is called.
        scenarios: Scenario -> what the column is called.
    """

    measure: str
    methods: Mapping[tuple[str, str], str]
    scenarios: Mapping[str, str]

    def markdown(self, results: pd.DataFrame) -> str:
        """Lay the table out.

        Args:
            results: Rows ``suite, scenario, seed, method, choice, group, measure, value``.

        Returns:
            The table; a cell is mean ± 95 % interval over seeds [lowest], or – without rows.

        Raises:
            ValueError: If ``results`` lacks one of these columns.
        """
        columns = ["scenario", "seed", "method", "choice", "group", "measure", "value"]
        require_columns(results, columns)
        rows = results[(results["measure"] == self.measure) & (results["group"] != "all")]
        lines = []
        for (method, choice), label in self.methods.items():
            own = rows[(rows["method"] == method) & (rows["choice"].fillna("") == choice)]
            cells = [_cell(own[own["scenario"] == scenario]) for scenario in self.scenarios]
            lines.append([label, *cells])
        head = ["method", *self.scenarios.values()]
        return markdown_table(head, lines, right=len(self.scenarios))


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


def _cell(rows: pd.DataFrame) -> str:
    worst = rows.groupby("seed")["value"].min()
    if worst.empty:
        return "–"
    mean, half = interval(worst.to_numpy())
    spread = f" ± {half:.2f}" if len(worst) > 1 else ""
    return f"{mean:.2f}{spread} [{worst.min():.2f}]"
