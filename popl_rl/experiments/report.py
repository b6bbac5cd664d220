"""What came out of a run, as a table in the terminal and as ``report.md``."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from popl_rl.evaluation.diagnostics import alarm, left_data, unexplained
from popl_rl.evaluation.method_names import method_name
from popl_rl.evaluation.statistics import (
    HEADLINES,
    RESULT_COLUMNS,
    entries,
    headline_measure,
    interval,
    require_columns,
    worst_group,
)
from popl_rl.evaluation.verdicts import FEW, PARTLY, SERVED, verdicts
from popl_rl.experiments.markdown import markdown_table
from popl_rl.experiments.people_report import people_alarm, people_table

__all__ = ["markdown", "print_results", "results_table", "verdict_lines"]

_COLOURS = {SERVED: "green", PARTLY: "yellow", FEW: "yellow"}  # of verdicts; red for any other

_SHARES = ("success", "accuracy")

_WORDS = {
    "served": "new raters are given at least 0.8 of the best known, as far as the episodes tell: "
    "optimum, PPO, oracle, best behaviour in the data or clone of all of them, whichever has the "
    "highest return.",
    "no better than the data": "nothing was gained over what the data show, in their shares.",
    "its oracle does not act": "a policy that is told the group's own answers is no better than "
    "random actions, or worse than the data, so that a recovery means nothing: give all methods "
    "more training, other data, or style codes (`method.evolve=code`).",
    "not found": "less than half of the best known, although an oracle can do it.",
    "group": "raters who want the same. No method but the oracle is told who belongs to which.",
    "POPL (catered)": "the policy that the policy set offers to a new rater of the group after a "
    "few answers.",
    "oracle": "trained on the answers of this group alone, so it knows what POPL has to find out.",
    "share of optimum": "(return − random) / (optimum − random), of exact returns, where the "
    "environment lists its transitions or items are chosen: 1 is the best that the group can get "
    "at all, 0 as bad as random actions.",
    "return": "sum over an episode of what the group's raters value, averaged over episodes.",
    "recovery": "(return − floor) / (oracle's return − floor): 1 is as good as the oracle, 0 as "
    "bad as random actions, or as what `evaluation.reference` names in their place.",
    "worst-served group": "the one with the lowest share of the optimum, or recovery where that is "
    "unknown. It is what counts: a method that serves the majority alone has a low one.",
    "success": "share of episodes that fulfil the task, whatever the group wants besides.",
    "accuracy": "share of pairs of segments, not used in training, that the policy ranks as the "
    "group does; 50 % is guessing.",
}


def results_table(results: pd.DataFrame) -> Table:
    """Lay out results for a terminal: a row for each method and group.

    Args:
        results: Tidy rows ``method, choice, group, measure, value``. Several rows of the same, such
            as seeds, are shown as their mean and its 95 % interval.

    Returns:
        Columns return, share of optimum (recovery where that is unknown), success and accuracy,
        with a dash for what was not measured.

    Raises:
        ValueError: If a column is missing.
    """
    require_columns(results, RESULT_COLUMNS)
    table = Table("method", "raters who want", title="How well is each group served?")
    for measure in _measures(results):
        table.add_column(HEADLINES.get(measure, measure), justify="right")
    previous = None
    for method, group, *cells in _rows(results):
        if previous not in (None, method):
            table.add_section()
        table.add_row(method if method != previous else "", Text(group), *cells)
        previous = method
    return table


def verdict_lines(results: pd.DataFrame, label: str) -> list[Text]:
    """Lines for a terminal that say how well each group is served.

    Args:
        results: Tidy rows ``method, choice, group, measure, value`` of one run.
        label: Name of the method that was evaluated.

    Raises:
        ValueError: If a column is missing.
    """
    return [
        Text(str(verdict), style=_COLOURS.get(verdict.word, "red"))
        for verdict in verdicts(results, label)
    ]


def print_results(console: Console, results: pd.DataFrame, label: str) -> None:
    """Print the table of a run, and what it warns of.

    Args:
        console: The terminal.
        results: Rows of a scoreboard, or over people.
        label: Name of the method that was run.
    """
    of_people = bool(results["measure"].str.startswith("accuracy@0").any())
    for line in [] if of_people else verdict_lines(results, label):
        console.print(line, soft_wrap=True)
    console.print(people_table(results) if of_people else results_table(results))
    alarms = [alarm(results), unexplained(results)]
    if of_people:
        alarms = [people_alarm(results, label)]
    for problem in filter(None, alarms):
        console.print(f"alarm: {problem}", style="bold red", highlight=False, soft_wrap=True)
    warning = None if of_people else left_data(results)
    if warning:
        console.print(f"warning: {warning}", style="yellow", highlight=False, soft_wrap=True)


def markdown(
    results: pd.DataFrame,
    *,
    title: str,
    about: Mapping[str, Any],
    figures: Sequence[Path],
    label: str,
) -> str:
    """Write the text of a report.

    Args:
        results: Tidy rows ``method, choice, group, measure, value``.
        title: Heading.
        about: What was run, such as environment, groups and seed.
        figures: Pictures, relative to the folder of the report.
        label: Name of the method that was evaluated.

    Returns:
        Markdown: a verdict for each group, what was run, the results, the pictures, and what the
        words mean.

    Raises:
        ValueError: If a column is missing or a path in ``figures`` is absolute.
    """
    absolute = [str(figure) for figure in figures if figure.is_absolute()]
    if absolute:
        raise ValueError(
            f"figures must be relative to the report's folder, so that it can be moved, got "
            f"{absolute}; use figure.relative_to(run_dir)"
        )
    require_columns(results, RESULT_COLUMNS)
    measures, headline = _measures(results), headline_measure(results)
    # 0 by definition, as a recovery of the oracle is 1.
    trivial = ("random",) if headline == "share_of_optimum" else ("random", "oracle")
    worst = [
        f"{method_name(*entry)} **{value:z.2f}**"
        for entry, value in worst_group(results, headline).items()
        if entry[0] not in trivial
    ]
    blocks = [f"# {title}"]
    said = [
        f"- **{verdict.group}**: {str(verdict).partition(': ')[2]}"
        for verdict in verdicts(results, label)
    ]
    if said:
        blocks.append("\n".join(said))
    if about:
        blocks.append(markdown_table(["", ""], [[key, value] for key, value in about.items()]))
    blocks.append("## How well is each group served?")
    if worst:
        name = HEADLINES[headline].capitalize()
        blocks.append(f"{name} of the worst-served group: {', '.join(worst)}.")
    head = ["method", "raters who want", *(HEADLINES.get(name, name) for name in measures)]
    blocks.append(markdown_table(head, _rows(results), right=len(measures)))
    blocks.append("Every number measured is in `results.csv`.")
    for figure in figures:
        name = figure.stem.replace("_", " ")
        blocks.append(f"![{name}]({quote(figure.as_posix())})")
    blocks.append("## Words")
    blocks.append("\n".join(f"- **{word}**: {meaning}" for word, meaning in _WORDS.items()))
    return "\n\n".join(blocks) + "\n"


def _measures(results: pd.DataFrame) -> list[str]:
    return ["return", headline_measure(results), "success", "accuracy"]


def _rows(results: pd.DataFrame) -> Iterator[list[str]]:
    """Cells of the table: method, group, and the measures in their order."""
    measures = _measures(results)
    # In dictionaries: a table of pandas for each cell takes a tenth of a second.
    found: dict[tuple[str, str], dict[str, dict[str, list[float]]]] = {}
    for method, choice, group, measure, value in results[RESULT_COLUMNS].itertuples(index=False):
        of_group = found.setdefault((method, choice), {}).setdefault(str(group), {})
        of_group.setdefault(measure, []).append(value)
    for entry in entries(results):
        for group, values in found[entry].items():
            if not set(values) & set(measures):
                continue
            cells = [_cell(name, values.get(name, [])) for name in measures]
            yield [method_name(*entry), group, *cells]


def _cell(measure: str, values: list[float]) -> str:
    numbers = [value for value in values if not math.isnan(value)]
    if not numbers:
        return "–"
    scale, decimals, unit = (100, 0, " %") if measure in _SHARES else (1, 2, "")
    mean, half = interval(numbers)
    text = f"{scale * mean:z.{decimals}f}"
    if len(numbers) > 1:
        text += f" ± {scale * half:.{decimals}f}"
    return text.replace("-", "−") + unit
