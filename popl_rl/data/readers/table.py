"""Comparisons in a table (csv, jsonl, parquet), beside a table of what is compared."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from tensordict import TensorDict

from popl_rl.data.readers.answers import read_answers
from popl_rl.data.readers.files import first_row, read_pieces
from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.readers.items import Items, read_items, read_segments
from popl_rl.data.readers.problems import Problems
from popl_rl.keys import ANSWER, CHANCE, CONDITION, PAIR, RANKING, RATER, Answer

__all__ = ["check_sides", "number_rankings", "preferences_of", "read_table"]


def read_table(
    path: Path,
    *,
    items: str | None = None,
    segments: str | None = None,
    features: str | None = None,
    text: str = "text",
    length: int | None = None,
    first: str = "first",
    second: str = "second",
    answer: str = "answer",
    rater: str = "rater",
    condition: str = "condition",
    ranking: str = "ranking",
    one_sided: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Imported:
    """Read comparisons and what they compare.

    The table has the columns ``first``, ``second`` (ids) and ``answer`` (see
    `popl_rl.data.readers.answers.read_answers`), and may have ``rater`` and ``condition``.

    Args:
        path: The comparisons.
        items: Table or ``.npy`` file of items, see `popl_rl.data.readers.items.read_items`.
        segments: Segments, see `popl_rl.data.readers.items.read_segments`.
        features: ``.npy`` file with a row of features for each row of ``items``.
        text: Column of texts in ``items``.
        length: Steps of the segments of a Minari data set.
        first: Column of the id of what was shown first.
        second: Column of the id of what was shown second.
        answer: Column of answers.
        rater: Column of who answered; need not be there, and may be empty in some rows.
        condition: Column of what people were told or which group they are of; likewise. It is
            kept for evaluation and never read by a learner.
        ranking: Column of which ranking a comparison is part of; likewise. Each rater's may be
            numbered from 1. Rankings as lists are read by
            ``popl_rl.data.readers.rankings.read_rankings``.
        one_sided: Accept that all answers prefer the same side.
        progress: Called with the number of rows read so far.

    Raises:
        ValueError: Naming rows, if something makes no sense.
        FileNotFoundError: If a file does not exist.
    """
    if (items is None) == (segments is None):
        raise ValueError(
            "say what is compared by either items=<table or .npy> or segments=<table or folder>, "
            f"got items={items!r} and segments={segments!r}"
        )
    if items is not None:
        more = None if features is None else Path(features)
        things = read_items(Path(items), text=text, features=more)
    else:
        things = read_segments(Path(str(segments)), length=length)
    columns = {"first": first, "second": second, "answer": answer}
    pieces = list(_pieces(path, columns, (rater, condition, ranking), things, progress))
    if not sum(len(piece[0]) for piece in pieces):
        raise ValueError(f"{path} holds no comparisons, only a header")
    pair = np.concatenate([piece[0] for piece in pieces])
    said = pd.concat([piece[1] for piece in pieces], ignore_index=True)
    problems = Problems(path, first=first_row(path))
    code, chance = read_answers(said["answer"], problems)
    problems.check()
    if not one_sided:
        check_sides(code, path)
    who = said.get("rater")
    what = said.get("condition")
    preferences, raters, conditions = preferences_of(pair, code, chance, who, what)
    if "ranking" in said:
        preferences[RANKING] = number_rankings(said["ranking"], who)
    names = Names(things.ids, raters, conditions, things.texts)
    return Imported(things.segments, preferences, names)


def _pieces(
    path: Path,
    columns: dict[str, str],
    optional: tuple[str, str, str],
    things: Items,
    progress: Callable[[int], None] | None,
) -> Iterator[tuple[npt.NDArray[np.int64], pd.DataFrame]]:
    """Rows of the two items of each comparison, and what was said, piece by piece."""
    index = pd.Index(things.ids)
    problems = Problems(path, first=first_row(path))
    for piece in read_pieces(path, progress=progress):
        _check_columns(path, piece, columns)
        start = int(piece.index[0]) if len(piece) else 0
        sides = []
        for column in (columns["first"], columns["second"]):
            ids = _as_ids(piece[column])
            row = index.get_indexer(pd.Index(ids))
            problems.add(piece[column].isna(), f"the column {column!r} is empty", start=start)
            unknown = (row < 0) & piece[column].notna().to_numpy()
            if unknown.any():
                example = ids[unknown].iloc[0]
                text = f"the column {column!r} names an item that does not exist ({example!r})"
                problems.add(unknown, text, start=start)
            sides.append(row)
        same = (sides[0] == sides[1]) & (sides[0] >= 0)
        problems.add(same, "an item is compared with itself", start=start)
        kept = {"answer": piece[columns["answer"]]}
        for name, column in zip(("rater", "condition", "ranking"), optional, strict=True):
            if column in piece:
                kept[name] = piece[column]
        yield np.stack(sides, 1), pd.DataFrame(kept)
    problems.check()


def _check_columns(path: Path, piece: pd.DataFrame, columns: dict[str, str]) -> None:
    missing = [column for column in columns.values() if column not in piece]
    if not missing:
        return
    if "ranking" in piece:
        raise ValueError(
            f"{path} holds rankings of several items; read them by --reader rankings, or "
            "data.reader=rankings"
        )
    raise ValueError(
        f"{path} must have the columns {list(columns.values())}, {missing} are missing; it has "
        f"{list(piece)}. Other names are given by options, such as first=left"
    )


def _as_ids(column: pd.Series) -> pd.Series:
    """Ids as text; whole numbers as they are written in csv."""
    if pd.api.types.is_float_dtype(column):
        column = column.astype("Int64")
    return column.astype("string").fillna("").astype(object)


def check_sides(answer: npt.NDArray[np.int64], path: Path) -> None:
    """Raise if all strict answers prefer one side, which is a sign of a misread column.

    Raises:
        ValueError: If so.
    """
    strict = answer[answer <= Answer.SECOND]
    if len(strict) >= 10 and len(np.unique(strict)) == 1:
        side = "first" if strict[0] == Answer.FIRST else "second"
        raise ValueError(
            f"{path}: all {len(strict)} strict answers prefer the {side} of the pair; the column "
            "of answers may be another. If what was preferred always stands there, set "
            "one_sided=true"
        )


def number_rankings(ranking: pd.Series, rater: pd.Series | None) -> torch.Tensor:
    """Number rankings over all raters, who may each have numbered their own.

    Args:
        ranking: Which ranking each comparison is part of, ``[M]``, of any type; missing where of
            none.
        rater: Who answered, likewise; None if nobody kept it.

    Returns:
        Their numbers from 0, -1 where missing, ``[M]``.
    """
    columns = {"ranking": _as_ids(ranking)}
    if rater is not None:
        columns["rater"] = _as_ids(rater)
    there = pd.DataFrame(columns)[ranking.notna()]
    number = there.groupby(list(columns), sort=False).ngroup()
    found = number.reindex(ranking.index, fill_value=-1)
    return torch.from_numpy(found.to_numpy(np.int64, copy=True))


def preferences_of(
    pair: npt.NDArray[np.int64],
    answer: npt.NDArray[np.int64],
    chance: npt.NDArray[np.float32] | None,
    rater: pd.Series | None,
    condition: pd.Series | None,
) -> tuple[TensorDict, list[str], list[str]]:
    """Put columns together.

    Args:
        pair: Segments of each comparison, ``[M, 2]``.
        answer: Codes of the answers, ``[M]``.
        chance: How likely the second is preferred, ``[M]``, if there are soft labels.
        rater: Who answered, of any type; missing where unknown. None if nobody kept it.
        condition: Which condition, likewise.

    Returns:
        TensorDict ``[M]``, names of the raters, names of the conditions.
    """
    count = len(pair)
    data = TensorDict(
        {PAIR: torch.from_numpy(pair.astype(np.int64)), ANSWER: torch.from_numpy(answer)}, [count]
    )
    names: list[list[str]] = []
    for key, column in ((RATER, rater), (CONDITION, condition)):
        if column is None or not column.notna().any():
            names.append([])
            continue
        code, known = pd.factorize(_as_ids(column).where(column.notna().to_numpy()))
        data[key] = torch.from_numpy(code.astype(np.int64))
        names.append([str(name) for name in known])
    if chance is not None:
        data[CHANCE] = torch.from_numpy(chance)
    return data, names[0], names[1]
