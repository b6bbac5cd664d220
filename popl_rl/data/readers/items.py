"""What is compared, by id: rows of features, texts, or segments of several steps."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from tensordict import TensorDict, TensorDictBase

from popl_rl.data.readers.files import first_row, is_table, read_whole
from popl_rl.data.readers.minari import minari_segments
from popl_rl.data.readers.problems import Problems
from popl_rl.data.saved import load_segments
from popl_rl.keys import ACTION, MASK, OBSERVATION

__all__ = ["Items", "features_as_segments", "read_features", "read_items", "read_segments"]

_IDS = ("item", "id", "segment")


class Items(NamedTuple):
    """Segments and their ids.

    Attributes:
        segments: TensorDict ``[N, T]``.
        ids: Id of each segment, as text.
        texts: Text of each; empty if they are no texts.
    """

    segments: TensorDictBase
    ids: list[str]
    texts: list[str] = []


def features_as_segments(features: npt.NDArray[np.float32]) -> TensorDict:
    """Items with features ``[N, F]`` as segments of one step, in which there is nothing to do."""
    count = len(features)
    observation = torch.from_numpy(np.ascontiguousarray(features, np.float32)).unsqueeze(1)
    action = torch.zeros(count, 1, dtype=torch.long)
    return TensorDict({OBSERVATION: observation, ACTION: action}, [count, 1])


def read_features(path: Path) -> npt.NDArray[np.float32]:
    """Read features ``[N, F]`` of items from a ``.npy`` file.

    Raises:
        ValueError: If it holds no numbers of two dimensions, or numbers that are not finite.
        FileNotFoundError: If there is none.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        features = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path} is not readable as an array ({error})") from error
    if features.ndim != 2 or features.dtype.kind not in "fiub":
        raise ValueError(
            f"{path} must hold features of shape [items, features], got {features.dtype} of shape "
            f"{list(features.shape)}"
        )
    problems = Problems(path, first=0)
    problems.add(~np.isfinite(features).all(1), "features must be finite numbers")
    problems.check()
    return np.asarray(features, np.float32)


def read_items(path: Path, *, text: str = "text", features: Path | None = None) -> Items:
    """Read a table of items: a column of ids, numeric columns, perhaps a column of texts.

    Args:
        path: A table, or a ``.npy`` file of features, whose rows have the ids 0, 1, ...
        text: Name of the column of texts.
        features: A ``.npy`` file with a row for each row of the table, in the place of its numeric
            columns.

    Raises:
        ValueError: Naming the rows, if ids repeat or are missing, features are not finite, or
            there are neither numbers nor texts.
        FileNotFoundError: If a file does not exist.
    """
    if path.suffix == ".npy":
        values = read_features(path)
        return Items(features_as_segments(values), [str(row) for row in range(len(values))])
    table = read_whole(path)
    problems = Problems(path, first=first_row(path))
    ids = _ids(table, problems, path)
    texts: list[str] = []
    if text in table:
        problems.add(table[text].isna(), f"the column {text!r} must hold a text")
        texts = table[text].fillna("").astype(str).tolist()
    if features is None:
        columns = [name for name in table if name not in (*_IDS, text)]
        values = _numbers(table[columns], problems, strict=not texts)
    else:
        values = read_features(features)
        if len(values) != len(table):
            problems.add_text(
                f"{features} must have a row for each of the {len(table)} items, got {len(values)}"
            )
    if not values.shape[1] and not texts:
        problems.add_text(
            f"items need numeric columns or a column {text!r}, got the columns {list(table)}"
        )
    problems.check()
    return Items(features_as_segments(values), ids, texts)


def read_segments(path: Path, *, length: int | None = None) -> Items:
    """Read segments of several steps.

    Args:
        path: A table with a row for each step (columns ``segment``, ``action`` or ``action_0``,
            ``action_1``, ..., and numeric columns of the observation; rows of a segment in the
            order of its steps, or of a column ``step``); a folder of segments of ours, or the
            folder ``data`` above it; or a folder of a Minari data set. In folders the ids are
            0, 1, ...
        length: Steps of the segments that a Minari data set is cut into.

    Returns:
        Segments, as long as the longest, with a mask if some are shorter.

    Raises:
        ValueError: Naming the rows, if columns are missing or values make no sense.
        FileNotFoundError: If there is no such file or folder.
    """
    if is_table(path):
        return _step_table(path)
    if (path / "segments").is_dir():
        path = path / "segments"
    if any(path.glob("**/main_data.hdf5")):
        segments: TensorDictBase = minari_segments(path, length=length)
    else:
        segments = load_segments(path)
    return Items(segments, [str(row) for row in range(len(segments))])


def _ids(table: pd.DataFrame, problems: Problems, path: Path) -> list[str]:
    name = next((name for name in _IDS if name in table), None)
    if name is None:
        raise ValueError(
            f"{path} must have a column of ids named {', '.join(_IDS)}, got the columns "
            f"{list(table)}"
        )
    problems.add(table[name].isna(), f"the id in the column {name!r} is missing")
    repeated = table[name].duplicated() & table[name].notna()
    if repeated.any():
        first = table[name][repeated].iloc[0]
        problems.add(repeated, f"the id repeats one above ({first!r}); every item needs its own")
    return table[name].astype(str).tolist()


def _numbers(table: pd.DataFrame, problems: Problems, *, strict: bool) -> npt.NDArray[np.float32]:
    """Numeric columns ``[N, F]``; others are a problem if ``strict``, else left out."""
    columns = []
    for name in table:
        column = pd.to_numeric(table[name], errors="coerce")
        if not strict and not np.isfinite(column).any():
            continue  # a note on a text, such as its topic
        wrong = ~np.isfinite(column.to_numpy(float, na_value=np.nan))
        problems.add(wrong, f"the column {name!r} must hold finite numbers")
        columns.append(column.to_numpy(float, na_value=np.nan))
    return np.stack(columns, 1).astype(np.float32) if columns else np.zeros((len(table), 0), "f4")


def _step_table(path: Path) -> Items:
    table = read_whole(path)
    problems = Problems(path, first=first_row(path))
    parts = sorted(
        (name for name in table if str(name).startswith("action_")),
        key=lambda name: (len(str(name)), str(name)),
    )
    if "segment" not in table or not ("action" in table or parts):
        raise ValueError(
            f"{path} must have the columns 'segment', 'action' (or 'action_0', 'action_1', ...) "
            f"and numeric columns of observations, got {list(table)}"
        )
    problems.add(table["segment"].isna(), "the column 'segment' is missing")
    named = parts or ["action"]
    action = _numbers(table[named], problems, strict=True)
    seen = [name for name in table if name not in ("segment", "step", *named)]
    observation = _numbers(table[seen], problems, strict=True)
    if not seen:
        problems.add_text("there is no numeric column of an observation")
    problems.check()
    order = np.arange(len(table))
    if "step" in table:
        step = pd.to_numeric(table["step"], errors="coerce")
        problems.add(step.isna(), "the column 'step' must hold numbers")
        problems.check()
        order = np.argsort(step.to_numpy(), kind="stable")
    code, ids = pd.factorize(table["segment"].astype(str), sort=False)
    order = order[np.argsort(code[order], kind="stable")]
    size = np.bincount(code)
    begin = np.cumsum(size) - size
    place = np.arange(size.max())
    mask = place < size[:, None]
    # What is not there repeats the last step, which is valid and counts for nothing.
    row = order[begin[:, None] + np.minimum(place, size[:, None] - 1)]
    discrete = named == ["action"] and bool((action % 1 == 0).all())
    taken = action[row, 0].astype(np.int64) if discrete else action[row]
    data = {OBSERVATION: torch.from_numpy(observation[row]), ACTION: torch.from_numpy(taken)}
    if not mask.all():
        data[MASK] = torch.from_numpy(mask)
    return Items(TensorDict(data, list(row.shape)), list(map(str, ids)))
