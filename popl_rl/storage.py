"""Files and folders that are never half-written: write beside the target, then rename; locks."""

import errno
import fcntl
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

__all__ = [
    "explaining_full_disk",
    "load_tensordict",
    "locked",
    "save_tensordict",
    "write_atomic",
    "write_json",
]


def save_tensordict(data: TensorDictBase, path: Path) -> None:
    """Write a TensorDict as memory maps and JSON: beside the target first, then renamed.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or choose another path")
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        data.detach().cpu().clone().memmap(beside / "data", copy_existing=True)
        (beside / "data").rename(path)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def load_tensordict(path: Path, *, required: Mapping[str, int] | None = None) -> TensorDict:
    """Read what :func:`save_tensordict` wrote, into memory.

    Args:
        path: Folder to read.
        required: Keys that must be there and the least number of dimensions of each.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If the folder is truncated, damaged, or holds something else.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"no saved data at {path}: expected the folder of an earlier run")
    try:
        _check_whole(path)
        data: TensorDict = TensorDict.load_memmap(path, allow_pickle=False).clone()
    except Exception as error:
        raise ValueError(
            f"{path} is not readable as saved data ({error}); it is truncated or was written by "
            "something else; use another path or collect it again"
        ) from error
    for key, ndim in (required or {}).items():
        if key not in data.keys(True) or (ndim and data[key].ndim < ndim):
            raise ValueError(
                f"{path} does not hold what was expected: {key!r} with at least {ndim} dimensions "
                f"is missing; it has {sorted(map(str, data.keys(True, True)))}"
            )
    return data


def _check_whole(path: Path) -> None:
    """Compare the size of the files with what ``meta.json`` declares, at every level.

    Loading would fill what is missing with zeros, and lengthen the file.
    """
    for about in path.rglob("meta.json"):
        entries = json.loads(about.read_text()).values()
        declared = sum(
            math.prod(entry["shape"])
            * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
            for entry in entries
            if isinstance(entry, dict) and "dtype" in entry
        )
        held = sum(file.stat().st_size for file in about.parent.glob("*.memmap"))
        if held != declared:
            raise ValueError(f"{about.parent} holds {held} bytes of tensors instead of {declared}")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Be the only process, on this machine or another, that makes what belongs to ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with (path.parent / f".{path.name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def explaining_full_disk(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise OSError(
            error.errno,
            f"could not write {path.name}, the disk is full or its quota is used up; the files "
            "written earlier are intact: free some space and resume the run",
            str(path),
        ) from error


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a whole file, so that readers see either the old content or the new one.

    Args:
        path: The file; its folder exists.
        content: Text, written as UTF-8, or bytes.

    Raises:
        OSError: If it cannot be written; the old content is kept.
    """
    data = content.encode() if isinstance(content, str) else content
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with explaining_full_disk(path):
        try:
            with beside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file with :func:`write_atomic`."""
    write_atomic(path, json.dumps(value, indent=2) + "\n")
