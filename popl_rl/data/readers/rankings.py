"""Rankings of several items, the best first, in a table beside the table of the items."""

import json
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from popl_rl.data.readers.files import first_row, read_pieces
from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.readers.items import read_items
from popl_rl.data.readers.problems import Problems
from popl_rl.data.readers.table import preferences_of
from popl_rl.keys import RANKING

__all__ = ["read_rankings"]

_EXPECTED = (
    "a ranking is a list of two item ids or more, the best first: a JSON list, or ids with > or "
    "spaces between them"
)


def read_rankings(
    path: Path,
    *,
    items: str,
    features: str | None = None,
    text: str = "text",
    ranking: str = "ranking",
    rater: str = "rater",
    condition: str = "condition",
    progress: Callable[[int], None] | None = None,
) -> Imported:
    """Read rankings, each of which becomes the comparisons of an item with all behind it.

    Args:
        path: A table, see ``popl_rl.data.readers.files.read_pieces``.
        items: Table or ``.npy`` file of items, see ``popl_rl.data.readers.items.read_items``.
        features: ``.npy`` file with a row of features for each row of ``items``.
        text: Column of texts in ``items``.
        ranking: Column of the rankings: lists of ids, or text such as ``b > a > c``.
        rater: Column of who ranked; need not be there, and may be empty in some rows.
        condition: Column of a group or condition; likewise, and never read by a learner.
        progress: Called with the number of rows read so far.

    Returns:
        Segments, and preferences with the number of the ranking that each is part of, from 0.

    Raises:
        ValueError: Naming rows, if something makes no sense.
        FileNotFoundError: If a file does not exist.
    """
    things = read_items(
        Path(items), text=text, features=None if features is None else Path(features)
    )
    place = {name: number for number, name in enumerate(things.ids)}
    problems = Problems(path, first=first_row(path))
    rows: list[list[int]] = []
    said = []
    for piece in read_pieces(path, progress=progress):
        if ranking not in piece:
            raise ValueError(
                f"{path} must have the column {ranking!r}, it has {list(piece)}; another name is "
                "given by ranking=<column>"
            )
        rows += _ranked(piece[ranking], place, problems)
        said.append(piece[[name for name in (rater, condition) if name in piece]])
    problems.check()
    if not rows:
        raise ValueError(f"{path} holds no rankings, only a header")
    size = np.array([len(row) for row in rows])
    count = size * (size - 1) // 2
    pair = np.array([both for row in rows for both in combinations(row, 2)])
    # In turns first and second, so that no answer is one-sided.
    answer = np.arange(len(pair)) % 2
    pair = np.where(answer[:, None] == 1, pair[:, ::-1], pair)
    every = pd.concat(said, ignore_index=True).loc[np.arange(len(rows)).repeat(count)]
    every = every.reset_index(drop=True)
    columns = [every.get(name) for name in (rater, condition)]
    preferences, raters, conditions = preferences_of(pair, answer, None, *columns)
    preferences[RANKING] = torch.arange(len(rows)).repeat_interleave(torch.from_numpy(count))
    names = Names(things.ids, raters, conditions, things.texts)
    return Imported(things.segments, preferences, names)


def _ranked(column: pd.Series, place: dict[str, int], problems: Problems) -> list[list[int]]:
    """Numbers of the items of each ranking; what makes no sense is reported."""
    start = int(column.index[0]) if len(column) else 0
    found = [_ids(value) for value in column]
    unknown = [next((one for one in ids if one not in place), None) for ids in found]
    example = next((one for one in unknown if one is not None), None)
    wrong = [one is not None for one in unknown]
    problems.add(wrong, f"an item does not exist ({example!r})", start=start)
    problems.add([len(ids) < 2 for ids in found], _EXPECTED, start=start)
    twice = [len(set(ids)) < len(ids) for ids in found]
    problems.add(twice, "an item is ranked twice", start=start)
    return [[place.get(one, 0) for one in ids] for ids in found]


def _ids(value: object) -> list[str]:
    """Ids of one ranking as text; empty where there is none."""
    if isinstance(value, str) and value.strip().startswith("["):
        try:
            value = json.loads(value)
        except ValueError:
            return []
    if isinstance(value, list | tuple | np.ndarray):
        return [str(one) for one in value]
    if isinstance(value, str):
        return [one for one in value.replace(">", " ").split() if one]
    return []
