"""Tables in csv, jsonl or parquet, compressed or not, read in pieces."""

import gzip
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd

__all__ = ["KINDS", "first_row", "is_table", "kind_of", "read_pieces", "read_whole"]

#: Endings of tables, each of which ``.gz`` may follow (but ``.parquet``).
KINDS = {".csv": "csv", ".tsv": "tsv", ".jsonl": "jsonl", ".ndjson": "jsonl", ".parquet": "parquet"}
_PIECE = 200_000  # rows


def kind_of(path: Path) -> str | None:
    """``csv``, ``tsv``, ``jsonl`` or ``parquet`` by a file's name; None for another."""
    return KINDS.get(Path(path.name.removesuffix(".gz")).suffix)


def is_table(path: Path) -> bool:
    """Whether a file's name ends as that of a table."""
    return kind_of(path) is not None


def first_row(path: Path) -> int:
    """Number of the first row of data as an editor counts: 2 after the header of a csv file."""
    return 2 if kind_of(path) in ("csv", "tsv") else 1


def read_pieces(
    path: Path, *, progress: Callable[[int], None] | None = None
) -> Iterator[pd.DataFrame]:
    """Read a table some hundred thousand rows at a time.

    Args:
        path: The file; its name says what it is.
        progress: Called with the number of rows read so far.

    Yields:
        Pieces of the table, every column of csv as text, with row numbers from 0 as the index.

    Raises:
        ValueError: If its name ends in none of `KINDS`, it is in another encoding than
            UTF-8, or it cannot be parsed.
        FileNotFoundError: If there is none.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    kind = kind_of(path)
    if kind is None:
        endings = ", ".join(KINDS)
        raise ValueError(f"{path} must end in one of {endings} (or that and .gz), got {path.name}")
    done = 0
    try:
        for piece in _pieces(path, kind):
            piece.index = pd.RangeIndex(done, done + len(piece))
            done += len(piece)
            yield piece
            if progress is not None:
                progress(done)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} must be text in UTF-8, but {_where(path, error)}; save it as UTF-8"
        ) from error
    except (pd.errors.ParserError, pd.errors.EmptyDataError, gzip.BadGzipFile, EOFError) as error:
        raise ValueError(f"{path} is not readable as {kind}: {error}") from error
    except ValueError as error:
        if kind == "jsonl" and str(path) not in str(error):
            raise ValueError(
                f"{path} must hold one JSON object in each line, row {_bad_line(path)} is not: "
                f"{error}"
            ) from error
        raise


def read_whole(path: Path) -> pd.DataFrame:
    """Read a table at once, as `read_pieces` does."""
    return pd.concat(list(read_pieces(path)))


def _pieces(path: Path, kind: str) -> Iterator[pd.DataFrame]:
    if kind == "parquet":
        from pyarrow import parquet  # heavy, and for this kind only

        for batch in parquet.ParquetFile(path).iter_batches(batch_size=_PIECE):
            yield batch.to_pandas()
        return
    options: dict[str, Any] = {"chunksize": _PIECE, "encoding": "utf-8"}
    if kind == "jsonl":
        with pd.read_json(path, lines=True, dtype=False, **options) as pieces:
            yield from pieces
        return
    # Ids such as 007 stay as they are written.
    options |= {"sep": "\t" if kind == "tsv" else ",", "dtype": "string", "keep_default_na": True}
    with pd.read_csv(path, **options) as pieces:
        yield from pieces


def _lines(path: Path) -> Iterator[bytes]:
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        yield from file


def _where(path: Path, error: UnicodeDecodeError) -> str:
    for number, line in enumerate(_lines(path), 1):
        try:
            line.decode("utf-8")
        except UnicodeDecodeError as found:
            return f"row {number} holds the byte {line[found.start]:#04x} ({found.reason})"
    return str(error)


def _bad_line(path: Path) -> int:
    import json

    for number, line in enumerate(_lines(path), 1):
        try:
            good = isinstance(json.loads(line), dict)
        except ValueError:
            good = False
        if not good and line.strip():
            return number
    return 1
