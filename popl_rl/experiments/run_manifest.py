"""What a run is: its id, its settings and its plug-ins, as they were when it was started.

``manifest.json`` of a run folder is written once, and compared whenever the folder is read. What
the run keeps, its data, sets and checkpoints, names the run's id. Folders of earlier versions have
no manifest; they are read as they were, and their data and sets with warnings.
"""

import uuid
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from popl_rl.config import load_config
from popl_rl.experiments.plug_ins import find_plug_ins, keep_plug_ins
from popl_rl.manifest import digest_of_bytes, read_sealed, sealed
from popl_rl.storage import MANIFEST, read_manifest, write_json

__all__ = [
    "check_own",
    "check_own_data",
    "config_text",
    "container",
    "is_run_of",
    "load_run_config",
    "run_id",
    "write_run_manifest",
]

_FORMAT = "popl_rl.run/1"


def container(config: Any) -> DictConfig:
    """A DictConfig, dataclass or dict as a DictConfig; a dataclass's types take twice the time."""
    if OmegaConf.is_config(config):
        return config  # type: ignore[no-any-return]
    return OmegaConf.create(asdict(config) if is_dataclass(config) else config)  # type: ignore[arg-type]


def config_text(config: Any) -> str:
    """What ``config.yaml`` says of a DictConfig, dataclass or dict, with references resolved."""
    return OmegaConf.to_yaml(container(config), resolve=True)


def is_run_of(run_dir: Path, config: Any) -> bool:
    """Whether a folder is that of a run which was started with these very settings.

    Raises:
        ValueError: If its manifest is damaged or was changed.
    """
    content = _read(run_dir)
    return content is not None and content["config"] == _digest(config)


def _digest(config: Any) -> str:
    return digest_of_bytes(config_text(config).encode())


def write_run_manifest(run_dir: Path, config: Any) -> None:
    """Give a new run an id, and keep its plug-ins.

    Args:
        run_dir: Folder of the run.
        config: Its settings, as ``config.yaml`` is going to say them: a DictConfig, dataclass or
            dict.

    Raises:
        OSError: If it cannot be written.
    """
    config = container(config)
    content = {
        "format": _FORMAT,
        "run": uuid.uuid4().hex,
        "config": _digest(config),
        "plug_ins": keep_plug_ins(run_dir, config),
    }
    write_json(run_dir / MANIFEST, sealed(content))


def run_id(run_dir: Path) -> str | None:
    """Id of a run; None for a folder of an earlier version, or of no run.

    Raises:
        ValueError: If the manifest is damaged or was changed.
    """
    content = _read(run_dir)
    return None if content is None else str(content["run"])


def load_run_config(run_dir: Path) -> DictConfig:
    """Settings of a run, as it was started with them; plug-ins are found from any folder.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If ``config.yaml`` or a plug-in's copy was changed or damaged.
    """
    config, content = load_config(run_dir), _read(run_dir)
    if content is None:
        return config
    path = run_dir / "config.yaml"
    if digest_of_bytes(path.read_bytes()) != content["config"]:
        raise ValueError(
            f"{path} was changed or damaged after the run was started, so that what is in the "
            "folder is no result of these settings; restore it, or start another run with them"
        )
    return find_plug_ins(run_dir, config, content["plug_ins"])


def check_own(run_dir: Path, provenance: Mapping[str, Any], path: Path) -> None:
    """Raise unless something is of the run in whose folder it is.

    Args:
        run_dir: Folder of the run.
        provenance: What it says of where it is from.
        path: Where it is, for the message.

    Raises:
        ValueError: If it is of another run, or only one of the two knows.
    """
    own = run_id(run_dir)
    if provenance.get("run") != own:
        raise ValueError(
            f"{path} is of run {provenance.get('run') or 'unknown'}, but {run_dir} is the folder "
            f"of run {own or 'unknown'}: something was exchanged; restore the folder from a copy"
        )


def check_own_data(run_dir: Path) -> None:
    """Raise unless the data in a run's folder are its own; data elsewhere are anybody's.

    Raises:
        ValueError: If they are of another run.
    """
    path = run_dir / "data" / "preferences"
    if run_id(run_dir) is not None:
        manifest = read_manifest(path)
        check_own(run_dir, {} if manifest is None else manifest["about"], path)


def _read(run_dir: Path) -> dict[str, Any] | None:
    path = run_dir / MANIFEST
    if not path.exists():
        return None
    content = read_sealed(path, cure="restore it from a copy, or start another run")
    if content.get("format") != _FORMAT:
        raise ValueError(f"{path} has format {content.get('format')!r}, expected {_FORMAT!r}")
    return content
