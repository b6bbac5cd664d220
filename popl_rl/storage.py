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
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # Imported where they are used: what writes JSON alone need not wait for PyTorch.
    from tensordict import TensorDict, TensorDictBase

__all__ = [
    "explaining_full_disk",
    "load_tensordict",
    "locked",
    "save_tensordict",
    "write_atomic",
    "write_json",
    "written_beside",
]


@contextmanager
def written_beside(path: Path) -> Iterator[Path]:
    """Write a whole folder or nothing: a folder to fill, which at the end takes the name ``path``.

    If the block fails, what it wrote is removed; if the process is killed, what it wrote stays
    beside the target, in a folder whose name begins with a dot. Folders above ``path`` are made.

    Args:
        path: The folder to be.

    Yields:
        An empty folder, on the same file system.

    Raises:
        FileExistsError: If ``path`` exists.

    Example:
        >>> with written_beside(Path(folder) / "set") as beside:
        ...     write_json(beside / "about.json", {"members": 3})
        >>> (Path(folder) / "set" / "about.json").is_file()
        True
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or choose another path")
    path.parent.mkdir(parents=True, exist_ok=True)
    outer = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        # The outer folder is for its owner's eyes only; this one has the usual permissions.
        beside = outer / "whole"
        beside.mkdir()
        yield beside
        beside.rename(path)
    finally:
        shutil.rmtree(outer, ignore_errors=True)


def save_tensordict(data: "TensorDictBase", path: Path) -> None:
    """Write a TensorDict of any shape as memory maps and JSON; nothing is left half-written.

    Args:
        data: What to write, from whichever device.
        path: The folder to be.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    with written_beside(path) as beside:
        data.detach().cpu().clone().memmap(beside, copy_existing=True)


def load_tensordict(path: Path, *, required: Mapping[str, int] | None = None) -> "TensorDict":
    """Read what ``save_tensordict`` wrote, into memory.

    Args:
        path: Folder to read.
        required: Keys that must be there and the least number of dimensions of each.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If the folder is truncated, damaged, or holds something else.
    """
    from tensordict import TensorDict

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
    import torch

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
    """Be the only process, on this machine or another, that makes what belongs to ``path``.

    Waits until no other process holds the lock, a hidden file beside ``path`` that stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with (path.parent / f".{path.name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def explaining_full_disk(path: Path) -> Iterator[None]:
    """Say of a full disk that it is full, what is safe and what to do.

    Args:
        path: The file that is being written.

    Raises:
        OSError: What the block raised; if the disk is full or its quota used up, explained.
    """
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
    """Write a JSON file with ``write_atomic``."""
    write_atomic(path, json.dumps(value, indent=2) + "\n")
