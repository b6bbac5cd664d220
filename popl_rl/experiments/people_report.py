"""What came out where real people judge: a table in the terminal, a report, a figure."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table

from popl_rl.evaluation.method_names import method_name
from popl_rl.experiments.markdown import markdown_table
from popl_rl.storage import write_atomic

__all__ = ["people_alarm", "people_table", "write_people_report"]

_WORDS = {
    "accuracy": "share of a held-out person's further answers that are predicted, averaged over "
    "people; 50 % is guessing.",
    "log-likelihood": "mean log-chance that was given to a further answer; −0.69 is guessing.",
    "catered": "predicted by the member that the person's first answers speak for most; before any "
    "answer, by the one that speaks for most other people.",
    "mixture": "predicted by all members, each as much as it is believed in.",
    "single": "the one member of the set that explains all other people's answers best.",
    "individual": "the hypothesis for all, fine-tuned on the person's own answers alone.",
    "interval": "95 %, bootstrap over people; paired where two methods are compared.",
    "worst decile": "mean accuracy of the tenth of people who are predicted worst.",
}


def _points(results: pd.DataFrame) -> list[int]:
    names = results["measure"][results["measure"].str.startswith("accuracy@")]
    return sorted({int(name.partition("@")[2]) for name in names})


def _rows(results: pd.DataFrame, group: str) -> list[list[str]]:
    """Cells of each method: accuracies after K answers, and the last gain over pooled CPL."""
    rows = results[results["group"] == group]
    points = _points(rows)
    lines = []
    for (method, choice), own in rows.groupby(["method", "choice"], sort=False):
        value = dict(zip(own["measure"], own["value"], strict=True))
        cells = [_percent(value.get(f"accuracy@{answers}")) for answers in points]
        last = f"@{points[-1]}"
        gain = [value.get(f"gain_over_pooled_cpl{end}{last}") for end in ("", "_low", "_high")]
        shares = [value.get(f"{what}_over_pooled_cpl_share{last}") for what in ("gain", "loss")]
        lines.append(
            [
                method_name(str(method), str(choice)),
                *cells,
                _number(value.get(f"log_likelihood{last}")),
                _percent(value.get(f"worst_decile{last}")),
                _interval(gain),
                " / ".join(_percent(share) for share in shares) if shares[0] is not None else "–",
            ]
        )
    return lines


def _head(results: pd.DataFrame) -> list[str]:
    points = _points(results)
    last = points[-1]
    return [
        "method",
        *(f"after {answers}" for answers in points),
        f"log-likelihood after {last}",
        f"worst decile after {last}",
        f"gain over pooled CPL after {last}",
        "people who gain / lose",
    ]


def people_table(results: pd.DataFrame, *, group: str = "all") -> Table:
    """Lay out results over people for a terminal.

    Args:
        results: Rows as of `popl_rl.evaluation.people_statistics.summarise_people`.
        group: Which people.
    """
    points = _points(results)
    # As many columns as a terminal of 80 has room for: first, middle and last, and the gain.
    shown = sorted({points[0], points[len(points) // 2], points[-1]})
    table = Table(title="How many further answers of new people are predicted?")
    table.add_column("method")
    for answers in shown:
        table.add_column(f"after {answers}", justify="right", no_wrap=True)
    table.add_column("gain over pooled", justify="right", no_wrap=True)
    for cells in _rows(results, group):
        table.add_row(cells[0], *(cells[1 + points.index(each)] for each in shown), cells[-2])
    return table


def people_alarm(results: pd.DataFrame, method: str) -> str | None:
    """What to say if catering predicts people no better than one hypothesis for all.

    Args:
        results: Rows over people, with pooled CPL as a reference.
        method: The method that learnt the set.

    Returns:
        A sentence; None if the set tells people apart, or nothing is known.
    """
    own = results[(results["method"] == method) & (results["group"] == "all")]
    if own.empty:
        return None
    last = _points(own)[-1]
    lows = own[own["measure"] == f"gain_over_pooled_cpl_low@{last}"]["value"]
    if lows.empty or lows.max() > 0:
        return None
    return (
        f"after {last} answers no choice from the set predicts people better than one hypothesis "
        "for all does (the paired interval holds 0): the set tells nobody apart, or people agree"
    )


def write_people_report(
    path: Path,
    results: pd.DataFrame,
    *,
    title: str,
    about: Mapping[str, Any],
    summary: list[str],
    figures: list[Path],
) -> None:
    """Write ``report.md``.

    Args:
        path: The file.
        results: Rows over people.
        title: Heading.
        about: What was run.
        summary: What was found in the data, line by line.
        figures: Pictures, relative to the report's folder.
    """
    blocks = [f"# {title}"]
    blocks.append(markdown_table(["", ""], [[key, value] for key, value in about.items()]))
    blocks.append("## The data\n\n```\n" + "\n".join(summary) + "\n```")
    blocks.append("## How many further answers of new people are predicted?")
    head = _head(results)
    blocks.append(markdown_table(head, _rows(results, "all"), right=len(head) - 1))
    for group in sorted(set(results["group"]) - {"all"}):
        blocks.append(f"### {group}")
        blocks.append(markdown_table(head, _rows(results, group), right=len(head) - 1))
    blocks += [f"![{each.stem.replace('_', ' ')}]({each.as_posix()})" for each in figures]
    blocks.append("Every number is in `results.csv`, every person's in `people.csv`.")
    blocks.append("## Words")
    blocks.append("\n".join(f"- **{word}**: {meaning}" for word, meaning in _WORDS.items()))
    write_atomic(path, "\n\n".join(blocks) + "\n")


def _percent(value: float | None) -> str:
    return "–" if value is None or value != value else f"{100 * value:.1f} %"


def _number(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.3f}".replace("-", "−")


def _interval(values: list[float | None]) -> str:
    mean, low, high = values
    if mean is None or low is None or high is None:
        return "–"
    text = f"{100 * mean:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"
    return text.replace("-", "−")
