"""Files and folders that are never half-written, and that tell when they are read if they changed.

They are written beside the target, then renamed. Tensors are saved with a manifest of their digests
(``popl_rl.manifest``), which is compared with what is read.
"""

import errno
import json
import math
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popl_rl.manifest import digest_of_tensors, read_json, read_sealed, sealed

if TYPE_CHECKING:
    # Imported where they are used: what writes JSON alone need not wait for PyTorch.
    from tensordict import TensorDict, TensorDictBase

__all__ = [
    "MANIFEST",
    "explaining_full_disk",
    "load_tensordict",
    "map_tensordict",
    "read_manifest",
    "reserve",
    "save_tensordict",
    "write_atomic",
    "write_json",
    "written_beside",
]

MANIFEST = "manifest.json"
"""File of a folder that says what the folder holds."""

_FORMAT = "popl_rl.tensors/1"
_CURE = "restore the folder from a copy, or make it again"
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


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


def save_tensordict(
    data: "TensorDictBase", path: Path, *, about: Mapping[str, Any] | None = None
) -> None:
    """Write a TensorDict of any shape as memory maps and JSON; nothing is left half-written.

    Beside them goes ``manifest.json``: digests of all tensors, and what is said about them.

    Args:
        data: What to write, from whichever device.
        path: The folder to be.
        about: What else the manifest says, as JSON can say it, such as to what the data belong.

    Raises:
        FileExistsError: If ``path`` exists.
        OSError: If there is no room; told before anything is written.
    """
    data = data.detach().cpu().clone()
    with written_beside(path) as beside, explaining_full_disk(path, need=_size(data)):
        _reserve_files(data, beside)
        data.memmap(beside, copy_existing=True, existsok=True)
        tensors = digest_of_tensors(data)
        content = {
            "format": _FORMAT,
            "digest": tensors.pop(""),
            "batch_size": list(data.batch_size),
            "tensors": tensors,
            "about": dict(about or {}),
        }
        write_json(beside / MANIFEST, sealed(content))


def _size(data: "TensorDictBase") -> int:
    """Bytes of all tensors."""
    return sum(value.numel() * value.element_size() for value in data.values(True, True))


def _reserve_files(data: "TensorDictBase", folder: Path) -> None:
    """Make the files with room for the tensors.

    A write through a memory map that finds no room cannot be caught: the process is killed.
    """
    largest = max(value.numel() * value.element_size() for value in data.values(True, True))
    reserve(folder, largest)  # a limit on the size of a file is told by this, not by what follows
    data.memmap_like(folder)
    for file in folder.rglob("*.memmap"):
        with file.open("r+b") as opened:
            size = file.stat().st_size
            if size:
                os.posix_fallocate(opened.fileno(), 0, size)


def read_manifest(path: Path) -> dict[str, Any] | None:
    """The manifest of saved tensors: ``digest`` of all, and ``about``, which ``save`` was told.

    Args:
        path: The folder.

    Returns:
        None for a folder of an earlier version, which has none.

    Raises:
        ValueError: If the manifest is damaged.
    """
    if not (path / MANIFEST).exists():
        return None
    content = read_sealed(path / MANIFEST, cure=_CURE)
    if content.get("format") != _FORMAT:
        raise ValueError(
            f"{path / MANIFEST} has format {content.get('format')!r}, expected {_FORMAT!r}; use "
            "the version of popl_rl that wrote it"
        )
    return content


def load_tensordict(
    path: Path, *, required: Mapping[str, int] | None = None, digest: str | None = None
) -> "TensorDict":
    """Read what ``save_tensordict`` wrote, into memory, and compare it with its manifest.

    Every byte is compared, which takes about a second for each GB. A folder of an earlier version
    has no manifest: unless ``digest`` is given, it is read with a warning, after its files' sizes
    were compared with the shapes that they are to hold.

    Args:
        path: Folder to read.
        required: Keys that must be there and the least number of dimensions of each.
        digest: What the digest must be, if somebody else has kept it.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If the folder is truncated, damaged, was changed, or holds something else.
    """
    data = map_tensordict(path, digest=digest).clone()
    for key, ndim in (required or {}).items():
        if key not in data.keys(True) or (ndim and data[key].ndim < ndim):
            raise ValueError(
                f"{path} does not hold what was expected: {key!r} with at least {ndim} dimensions "
                f"is missing; it has {sorted(map(str, data.keys(True, True)))}"
            )
    return data


def map_tensordict(path: Path, *, digest: str | None = None) -> "TensorDict":
    """Open what ``save_tensordict`` wrote as memory maps; see ``load_tensordict``."""
    from tensordict import TensorDict

    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"no saved data at {path}: expected the folder of an earlier run")
    manifest = read_manifest(path)
    try:
        _check_whole(path)
        data: TensorDict = TensorDict.load_memmap(path, allow_pickle=False)
    except Exception as error:
        raise ValueError(
            f"{path} is not readable as saved data ({error}); it is truncated or was written by "
            "something else; use another path or collect it again"
        ) from error
    _compare(data, path, manifest, digest)
    return data


def _compare(
    data: "TensorDict", path: Path, manifest: Mapping[str, Any] | None, digest: str | None
) -> None:
    """Raise unless the tensors are those of the manifest, and of the digest."""
    if manifest is None and digest is None:
        warnings.warn(
            f"{path} was saved by an earlier version, without a manifest: whether it is damaged "
            "or was mixed up cannot be told",
            stacklevel=3,
        )
        return
    found = digest_of_tensors(data)
    whole = found.pop("")
    if manifest is not None:
        told, batch_size = manifest["tensors"], manifest["batch_size"]
        wrong = [name for name in {**told, **found} if told.get(name) != found.get(name)]
        if wrong or whole != manifest["digest"] or list(data.batch_size) != batch_size:
            listed = ", ".join(map(repr, wrong)) or "its batch size"
            raise ValueError(
                f"{path} was changed or damaged after it was saved: {listed} is not what "
                f"{MANIFEST} says; {_CURE}"
            )
    if digest is not None and digest != whole:
        raise ValueError(
            f"{path} holds other tensors than those that belong here (digest {whole}, expected "
            f"{digest}); {_CURE}"
        )


def _check_whole(path: Path) -> None:
    """Compare the size of the files with what ``meta.json`` declares, at every level.

    Loading would fill what is missing with zeros, and lengthen the file.
    """
    import torch

    for about in path.rglob("meta.json"):
        entries = read_json(about, cure=_CURE).values()
        declared = sum(
            math.prod(entry["shape"])
            * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
            for entry in entries
            if isinstance(entry, dict) and "dtype" in entry
        )
        held = sum(file.stat().st_size for file in about.parent.glob("*.memmap"))
        if held != declared:
            raise ValueError(f"{about.parent} holds {held} bytes of tensors instead of {declared}")


def reserve(folder: Path, size: int) -> None:
    """Raise unless a file of this size can be written into a folder.

    Args:
        folder: The folder.
        size: Bytes.

    Raises:
        OSError: As writing would: the disk is full, a quota or a limit is reached.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        if size:
            os.posix_fallocate(file.fileno(), 0, size)


@contextmanager
def explaining_full_disk(path: Path, *, need: int | None = None) -> Iterator[None]:
    """Say of a full disk that it is full, what is safe and what to do.

    Args:
        path: The file or folder that is being written.
        need: Bytes that it takes, if they are known.

    Raises:
        OSError: What the block raised; if the disk is full, or its quota or the limit on a file's
            size is reached, explained.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_ROOM or "could not write" in str(error):
            raise
        above = next((above for above in path.absolute().parents if above.is_dir()), Path("/"))
        free = f"{_bytes(shutil.disk_usage(above).free)} are free there"
        sizes = free if need is None else f"{_bytes(need)} are needed, {free}"
        raise OSError(
            error.errno,
            f"could not write {path.name}, the disk is full, or its quota or the limit on a file's "
            f"size is used up ({sizes}); the files written earlier are intact: free some space and "
            "resume the run",
            str(path),
        ) from error


def _bytes(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count < 1e9 else f"{count / 1e9:.1f} GB"


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
