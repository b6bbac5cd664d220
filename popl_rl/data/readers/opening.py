"""Data by whichever reader fits, or by the one that is named."""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

from tensordict import TensorDictBase

from popl_rl.data.plugged import check_segments
from popl_rl.data.readers.files import is_table, read_pieces
from popl_rl.data.readers.imported import Imported
from popl_rl.keys import LEARNER_KEYS
from popl_rl.plug_ins import call, is_foreign, located
from popl_rl.registry import names, resolve

__all__ = ["guess_reader", "open_data"]


def guess_reader(path: Path) -> str:
    """Name of the reader for what is at a path, by its name and, of tables, its columns.

    Raises:
        ValueError: If no reader fits.
        FileNotFoundError: If there is nothing.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}")
    if path.is_dir():
        return "folder"
    if path.suffix == ".npz":
        return "npz"
    if is_table(path):
        piece = next(read_pieces(path), None)
        columns = [] if piece is None else list(piece)
        if "ranking" in columns and "answer" not in columns:
            return "rankings"
        return "chosen" if "chosen" in columns else "table"
    raise ValueError(
        f"no reader is known for {path.name}; name one of {', '.join(names('reader'))}, or one of "
        "your own, such as my_reader.py:read"
    )


def open_data(
    path: Path,
    *,
    reader: str | None = None,
    options: Mapping[str, Any] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Imported:
    """Read other people's data.

    Args:
        path: File or folder.
        reader: Reference of a reader; None for the one that fits.
        options: Further arguments of the reader.
        progress: Called with the number of rows read so far, by readers that tell.

    Returns:
        Segments, preferences, and names if the reader knows any.

    Raises:
        ValueError: If there is no such reader, or what it reads makes no sense.
        TypeError: If the reader does not take the options.
        FileNotFoundError: If there is nothing at ``path``.
    """
    chosen = guess_reader(path) if reader is None else reader
    read = cast("Callable[..., Any]", resolve("reader", chosen))
    given = dict(options or {})
    known = inspect.signature(read).parameters
    takes_all = any(each.kind is each.VAR_KEYWORD for each in known.values())
    unknown = [name for name in given if name not in known]
    if unknown and not takes_all:
        listed = [name for name in list(known)[1:] if name != "progress"]
        raise TypeError(
            f"reader {chosen!r} does not take {', '.join(unknown)}; it takes "
            f"{', '.join(listed) or 'no options'}"
        )
    if progress is not None and "progress" in known:
        given["progress"] = progress
    if not is_foreign(read):
        found = read(path, **given)
        return found if isinstance(found, Imported) else Imported(*found)
    found = call("reader", chosen, f"reading {path}", read, path, **given)
    with located(read):
        return _checked(found, chosen)


def _checked(found: Any, reader: str) -> Imported:
    """What a reader of other people's returned."""
    if not isinstance(found, tuple) or not 2 <= len(found) <= 3:
        got = f"{len(found)} values" if isinstance(found, tuple) else f"a {type(found).__name__}"
        raise TypeError(f"reader {reader!r} must return (segments, preferences), got {got}")
    read = Imported(*found)
    check_segments(read.segments, f"reader {reader!r}: segments")
    preferences = read.preferences
    if not isinstance(preferences, TensorDictBase) or len(preferences.batch_size) != 1:
        got = getattr(preferences, "batch_size", type(preferences).__name__)
        raise TypeError(f"reader {reader!r}: preferences must be a TensorDict [M], got {got}")
    missing = [key for key in LEARNER_KEYS if key not in preferences.keys()]  # noqa: SIM118
    if missing:
        raise ValueError(
            f"reader {reader!r}: preferences must hold {', '.join(map(str, LEARNER_KEYS))}, but "
            f"have no {', '.join(map(str, missing))}"
        )
    return read
