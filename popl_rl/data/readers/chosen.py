"""Lines with a chosen and a rejected text, as data sets for language models are published."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from popl_rl.data.readers.files import first_row, read_pieces
from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.readers.items import features_as_segments, read_features
from popl_rl.data.readers.problems import Problems
from popl_rl.data.readers.table import preferences_of

__all__ = ["read_chosen"]


def read_chosen(
    path: Path,
    *,
    features: str | None = None,
    rater: str = "rater",
    condition: str = "condition",
    drop_equal: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Imported:
    """Read texts in pairs of which the first was chosen.

    The columns are ``chosen`` and ``rejected``, texts or lists of messages with ``role`` and
    ``content``; a column ``prompt`` is put before both unless they begin with it. Equal texts are
    one item. The chosen one is shown first or second in turns, so that no answer is one-sided.

    Args:
        path: A table, see `popl_rl.data.readers.files.read_pieces`.
        features: ``.npy`` file with a row for each different text, in the order of their first
            appearance (chosen before rejected). Without it observations have a width of 0, until
            the texts are encoded.
        rater: Column of who chose; need not be there.
        condition: Column of a group or condition; likewise, and never read by a learner.
        drop_equal: Leave out rows whose two texts are the same.
        progress: Called with the number of rows read so far.

    Raises:
        ValueError: Naming rows, if something makes no sense.
        FileNotFoundError: If a file does not exist.
    """
    problems = Problems(path, first=first_row(path))
    sides, kept = [], []
    for piece in read_pieces(path, progress=progress):
        missing = [name for name in ("chosen", "rejected") if name not in piece]
        if missing:
            raise ValueError(
                f"{path} must have the columns 'chosen' and 'rejected', {missing} are missing; it "
                f"has {list(piece)}"
            )
        start = int(piece.index[0]) if len(piece) else 0
        for name in ("chosen", "rejected"):
            problems.add(piece[name].isna(), f"the column {name!r} is empty", start=start)
        prompt = piece["prompt"].map(_text) if "prompt" in piece else pd.Series("", piece.index)
        both = [_with_prompt(prompt, piece[name].map(_text)) for name in ("chosen", "rejected")]
        same = both[0] == both[1]
        if drop_equal:
            piece, both = piece[~same], [side[~same] for side in both]
        else:
            cure = "both texts are the same; leave such rows out with drop_equal=true"
            problems.add(same, cure, start=start)
        sides.append(np.stack([side.to_numpy(object) for side in both], 1))
        kept.append(piece[[name for name in (rater, condition) if name in piece]])
    problems.check()
    if not sides or not sum(map(len, sides)):
        raise ValueError(f"{path} holds no comparisons")
    code, texts = pd.factorize(np.concatenate(sides).ravel())
    pair = code.reshape(-1, 2)
    answer = np.arange(len(pair)) % 2
    pair = np.where(answer[:, None] == 1, pair[:, ::-1], pair)
    values = np.zeros((len(texts), 0), np.float32)
    if features is not None:
        values = read_features(Path(features))
        if len(values) != len(texts):
            raise ValueError(
                f"{features} must have a row for each of the {len(texts)} different texts of "
                f"{path}, got {len(values)}"
            )
    said = pd.concat(kept, ignore_index=True)
    columns = [said.get(name) for name in (rater, condition)]
    preferences, raters, conditions = preferences_of(pair, answer, None, *columns)
    names = Names([], raters, conditions, [str(text) for text in texts])
    return Imported(features_as_segments(values), preferences, names)


def _text(value: object) -> str:
    if isinstance(value, list | np.ndarray):
        return "\n\n".join(f"{turn['role']}: {turn['content']}" for turn in value)
    return "" if value is None or value is pd.NA else str(value)


def _with_prompt(prompt: pd.Series, reply: pd.Series) -> pd.Series:
    joined = [
        text if text.startswith(before) else f"{before}{text}"
        for before, text in zip(prompt, reply, strict=True)
    ]
    return pd.Series(joined, reply.index)
