"""Tables that are kept once they are made, so that what was killed goes on."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from popl_rl.manifest import digest_of_bytes, read_sealed, sealed
from popl_rl.storage import write_atomic, write_json

__all__ = ["kept_table"]


def kept_table(
    path: Path,
    make: Callable[[], pd.DataFrame],
    *,
    source: Mapping[str, str] | None = None,
    **reading: Any,
) -> pd.DataFrame:
    """Read a table, or make and write it, if it is not there or not as it was written.

    Args:
        path: A csv file; beside it a record knows its digest. Tables of earlier versions have none.
        make: Makes the table.
        source: Digests of what it is made of; a table of something else is made again.
        **reading: Arguments of ``pandas.read_csv``.

    Returns:
        The table, always as it is read.
    """
    source = dict(source or {})
    record = path.with_suffix(".json")
    if not _is_whole(path, record, source):
        content = make().to_csv(index=False)
        write_json(record, sealed({"table": digest_of_bytes(content.encode()), **source}))
        write_atomic(path, content)
    table: pd.DataFrame = pd.read_csv(path, **reading)
    return table


def _is_whole(path: Path, record: Path, source: dict[str, str]) -> bool:
    """Whether there is a table, as it was written; why one is made again is told."""
    if not path.is_file():
        return False
    if not record.exists():
        return not source
    try:
        known = read_sealed(record, cure="it is made again")
        if known.get("table") != digest_of_bytes(path.read_bytes()):
            raise ValueError(f"{path} was changed after it was written; it is made again")
        if any(known.get(name) != digest for name, digest in source.items()):
            raise ValueError(f"{path} was made of other data; it is made again")
    except (OSError, ValueError) as error:
        warnings.warn(str(error), stacklevel=3)
        return False
    return True
