"""Markdown, as reports write it."""

from collections.abc import Iterator, Sequence
from typing import Any

__all__ = ["markdown_table"]


def markdown_table(
    head: Sequence[str], rows: Iterator[list[str]] | list[list[Any]], right: int = 0
) -> str:
    """Lay out a Markdown table whose last ``right`` columns are numbers."""
    rule = ["---"] * (len(head) - right) + ["---:"] * right
    lines = [head, rule, *rows]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines
    )
