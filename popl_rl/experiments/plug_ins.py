"""Copies of the plug-in files of a run, so that it means the same later and from any folder.

Settings name plug-ins as ``path/file.py:attr``, relative to the folder in which a run was started.
A run keeps a copy of each such file and of the files beside it that it imports. Who reads the
settings later is given the file itself where it is still the same, and else the copy.
"""

import re
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from popl_rl.manifest import digest_of_bytes

__all__ = ["FOLDER", "find_plug_ins", "keep_plug_ins", "plug_in_digests"]

FOLDER = "plug_ins"
"""Folder of a run for the copies."""

_REFERENCE = re.compile(r"(?:ppo:)?(?P<file>[^:]+\.py):\S")


def keep_plug_ins(run_dir: Path, config: Any) -> dict[str, Any]:
    """Copy the files that settings name as plug-ins.

    Args:
        run_dir: Folder of the run.
        config: The settings.

    Returns:
        What ``find_plug_ins`` needs, as JSON can say it: by file, as it was named, the copies of it
        and of what it imports, with their digests, its own first.

    Raises:
        OSError: If a file cannot be copied.
    """
    kept: dict[str, Any] = {}
    for named in sorted(_named(config)):
        original = Path(named).expanduser().resolve()
        if not original.is_file():
            continue  # no plug-in, or one that will be missed where it is used
        folder = run_dir / FOLDER / str(len(kept))
        folder.mkdir(parents=True, exist_ok=True)
        copies = {}
        for file in _with_imports(original):
            shutil.copyfile(file, folder / file.name)
            copies[file.name] = _digest(folder / file.name)
        kept[named] = {"folder": str(folder.relative_to(run_dir)), "files": copies}
    return kept


def plug_in_digests(config: Any) -> dict[str, str | None]:
    """Digests of the files that settings name as plug-ins, and of what they import, by name."""
    files = [Path(named).expanduser().resolve() for named in sorted(_named(config))]
    return {
        file.name: _digest(file) for each in files if each.is_file() for file in _with_imports(each)
    }


def find_plug_ins(run_dir: Path, config: DictConfig, kept: Mapping[str, Any]) -> DictConfig:
    """Settings of a run, in which files that have changed or cannot be found are its own copies.

    Args:
        run_dir: Folder of the run.
        config: Its settings.
        kept: What ``keep_plug_ins`` returned.

    Returns:
        The settings, with other paths where they are needed; a file that has changed is told.

    Raises:
        ValueError: If a copy that is needed was damaged, changed or removed.
    """
    moved: dict[str, str] = {}
    for named, copy in kept.items():
        here = Path(named).expanduser()
        same = all(
            _digest(here.with_name(name)) == digest for name, digest in copy["files"].items()
        )
        if same:
            continue
        folder = (run_dir / copy["folder"]).resolve()
        wrong = [name for name, digest in copy["files"].items() if _digest(folder / name) != digest]
        if wrong:
            raise ValueError(
                f"{folder / wrong[0]}, the run's own copy of a plug-in, was damaged, changed or "
                f"removed; restore it, or bring {named} back as it was when the run was started"
            )
        if here.exists():
            warnings.warn(
                f"{here} has changed since the run in {run_dir} was started, whose own copy is "
                f"used: {folder / here.name}",
                stacklevel=2,
            )
        moved[named] = str(folder / here.name)
    if not moved:
        return config
    found: DictConfig = OmegaConf.create(_renamed(OmegaConf.to_container(config), moved))
    return found


def _digest(file: Path) -> str | None:
    return digest_of_bytes(file.read_bytes()) if file.is_file() else None


def _named(value: Any) -> set[str]:
    """Files that are named as plug-ins anywhere in some settings."""
    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value, resolve=True)
    if isinstance(value, Mapping):
        return set().union(*map(_named, value.values()))
    if isinstance(value, list | tuple):
        return set().union(*map(_named, value))
    match = _REFERENCE.match(value) if isinstance(value, str) else None
    return {match["file"]} if match else set()


def _renamed(value: Any, moved: Mapping[str, str]) -> Any:
    """The same settings with other files."""
    if isinstance(value, Mapping):
        return {key: _renamed(entry, moved) for key, entry in value.items()}
    if isinstance(value, list):
        return [_renamed(entry, moved) for entry in value]
    match = _REFERENCE.match(value) if isinstance(value, str) else None
    if match and match["file"] in moved:
        return value[: match.start("file")] + moved[match["file"]] + value[match.end("file") :]
    return value


def _with_imports(file: Path) -> list[Path]:
    """A file, and the files beside it that it imports, and so on."""
    found = [file]
    for one in found:
        text = one.read_text(encoding="utf-8", errors="replace")
        for other in sorted(file.parent.glob("*.py")):
            imports = rf"^\s*(import|from)\s+{re.escape(other.stem)}\b"
            if other not in found and re.search(imports, text, re.MULTILINE):
                found.append(other)
    return found
