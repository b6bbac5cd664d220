"""Segments that are collected once and read by every run that asks for the same."""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from popl_rl.locks import locked
from popl_rl.manifest import read_sealed, sealed
from popl_rl.storage import read_manifest, save_tensordict, write_json, written_beside

__all__ = ["store_path", "stored"]

_ABOUT = "made by"


def store_path(root: Path, name: str, about: Mapping[str, Any]) -> Path:
    """Folder of what is described by ``about``: other settings, another folder.

    Args:
        root: Folder of the store.
        name: What the folder's name begins with; characters unfit for a file become ``-``.
        about: All that decides about the contents, as JSON can say it.
    """
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()
    return Path(root) / f"{re.sub(r'[^A-Za-z0-9._-]+', '-', name)}-{digest[:10]}"


def stored(path: Path, about: Mapping[str, Any], make: Callable[[], TensorDictBase]) -> Path:
    """Make what belongs into a store's folder, unless it is there; wait for whoever makes it.

    The folder appears whole or not at all: an interrupted collection leaves nothing behind that
    another could mistake for data, and starts again.

    Args:
        path: A folder, as of ``store_path``.
        about: What ``store_path`` was told; kept in ``about.json``.
        make: Makes the segments ``[N, T]``.

    Returns:
        Folder of the segments, for ``popl_rl.storage.load_tensordict``.

    Raises:
        ValueError: If the folder holds something else.
    """
    segments = path / "segments"
    with locked(path):
        if path.exists():
            _check(path, about)
            return segments
        data = make()
        with written_beside(path) as beside:
            save_tensordict(data, beside / "segments")
            manifest = read_manifest(beside / "segments")
            assert manifest is not None
            write_json(
                beside / "about.json", sealed({_ABOUT: about, "segments": manifest["digest"]})
            )
    return segments


def _check(path: Path, about: Mapping[str, Any]) -> None:
    """Raise unless a folder says that it holds what is wanted.

    Folders of earlier versions have no seal and no digest; their segments are read with a warning.
    """
    record = path / "about.json"
    cure = "remove it to collect them again, or choose another data.store"
    try:
        found = read_sealed(record, cure=cure)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not a folder of stored segments ({error}); {cure}") from error
    is_old = found.pop("seal", "") is None
    if (found if is_old else found.get(_ABOUT)) != json.loads(json.dumps(about)):
        raise ValueError(f"{path} holds segments of other settings, see {record}; {cure}")
    manifest = read_manifest(path / "segments")
    if (None if manifest is None else manifest["digest"]) != found.get("segments" * (not is_old)):
        raise ValueError(f"{path} holds other segments than {record} says; {cure}")
