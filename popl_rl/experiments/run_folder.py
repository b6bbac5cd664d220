"""The run folder: what was run, with what, and what came out of it.

Files are written beside their place and renamed into it, so that whoever reads a run folder, or
continues a killed run, never finds half a file. Rows of ``metrics.csv`` are the exception: they
are appended, and a torn last one is dropped when the file is opened again.
"""

import errno
import importlib.metadata
import platform
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import torch

from popl_rl.experiments.loggers import RunLogger, make_logger
from popl_rl.experiments.plug_ins import FOLDER
from popl_rl.experiments.progress import Progress
from popl_rl.experiments.run_manifest import config_text
from popl_rl.locks import held
from popl_rl.manifest import read_json
from popl_rl.storage import MANIFEST, write_atomic, write_json, written_beside

__all__ = [
    "Progress",
    "RunLogger",
    "create_run_dir",
    "git_state",
    "in_use",
    "make_logger",
    "save_config",
    "write_metadata",
]

LOCK = ".lock"
"""File of a run folder that whoever works on the run holds."""

_PACKAGES = (
    "popl_rl",
    "torch",
    "torchrl",
    "tensordict",
    "gymnasium",
    "minigrid",
    "metaworld",
    "wandb",
    "numpy",
)


def create_run_dir(
    path: Path | None,
    *,
    name: str,
    resume: bool = False,
    fill: Callable[[Path], None] = lambda _: None,
) -> Path:
    """Make the folder of a run, or find the one to continue.

    A new folder appears with its first content.

    Args:
        path: The folder; None for ``runs/<date-time>-<name>`` under the current folder.
        name: Names the run where ``path`` is None; characters unfit for a folder become ``-``.
        resume: Continue the run in ``path`` instead of starting one.
        fill: Writes the first content of a new folder.

    Returns:
        The folder, which exists.

    Raises:
        FileExistsError: If ``path`` is there already and holds something, and ``resume`` is off.
        FileNotFoundError: If ``resume`` is on and ``path`` holds no run.
        ValueError: If ``resume`` is on without a ``path``.
    """
    if resume:
        if path is None:
            raise ValueError("path must name the run to resume, got None; give resume=<dir>")
        if not (path / "config.yaml").is_file():
            raise FileNotFoundError(
                f"no run to resume in {path}: it has no config.yaml; resume must name the folder "
                "of a run, such as runs/20260131-120000-popl"
            )
        return path
    if path is None:
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        base = Path("runs", f"{stamp}-" + re.sub(r"[^\w.-]+", "-", name))
        # Runs of one sweep can start within the same second.
        for folder in [base, *(base.with_name(f"{base.name}-{i}") for i in range(2, 1000))]:
            try:
                with written_beside(folder) as beside:
                    fill(beside)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY) and not folder.exists():
                    raise
                continue
            return folder
        raise FileExistsError(f"{base} and 998 folders like it exist; choose run_dir=<dir>")
    taken = FileExistsError(
        f"run_dir {path} exists and is not empty; choose another run_dir, or continue that run "
        f"with resume={path}"
    )
    if path.exists() and (not path.is_dir() or _holds_something(path)):
        raise taken
    if path.exists():  # empty, and perhaps a disk of its own
        with in_use(path):
            if _holds_something(path):  # another process was faster
                raise taken
            fill(path)
        return path
    try:
        with written_beside(path) as beside:
            fill(beside)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
            raise taken from error
        raise
    return path


def _holds_something(folder: Path) -> bool:
    """Whether there is more than what a run that was killed at once has left."""
    left = {LOCK} | ({MANIFEST, FOLDER} if not (folder / "config.yaml").exists() else set())
    return any(
        path.name not in left and not path.name.endswith(".tmp") for path in folder.iterdir()
    )


def save_config(run_dir: Path, cfg: Any) -> None:
    """Write ``config.yaml``: a DictConfig, dataclass or dict, with every reference resolved."""
    write_atomic(run_dir / "config.yaml", config_text(cfg))


@contextmanager
def in_use(run_dir: Path) -> Iterator[None]:
    """Be the only process that works on a run.

    Raises:
        HeldError: If another one, here or on another machine, is at it.
    """
    with held(run_dir / LOCK, what=f"{run_dir}, the folder of a run,"):
        yield


def write_metadata(run_dir: Path, *, command: Sequence[str]) -> None:
    """Write ``metadata.json``: versions, git commit, platform, device, command, start time.

    A resumed run keeps the entry of its first start and adds one to the list ``resumed``.

    Args:
        run_dir: Folder of the run.
        command: The program and its arguments, as in ``sys.argv``.
    """
    entry: dict[str, Any] = {
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": shlex.join(command),
        "git": _own_state(),
        "platform": platform.platform(),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        "versions": {
            "python": platform.python_version(),
            **{package: _version(package) for package in _PACKAGES},
        },
    }
    path = run_dir / "metadata.json"
    if path.exists():
        first = read_json(path, cure="remove it; the run goes on without what it says")
        first.setdefault("resumed", []).append(entry)
        entry = first
    write_json(path, entry)


@cache
def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


@cache
def _own_state() -> dict[str, Any] | None:
    """Our own checkout when this process first asks, which is nearer to when it was imported."""
    return git_state(Path(__file__).parents[1])


def git_state(checkout: Path) -> dict[str, Any] | None:
    """Tell what a checkout holds: its commit, and whether files differ from it.

    Args:
        checkout: Root of the checkout.

    Returns:
        ``commit`` and ``dirty``; None without git, or where the folder is no checkout of its own.
    """

    def ask(*question: str) -> str:
        command = ["git", "-C", str(checkout), *question]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        # An installed package may lie inside somebody else's checkout.
        top, commit = ask("rev-parse", "--show-toplevel", "HEAD").splitlines()
        if Path(top).resolve() != checkout.resolve():
            return None
        return {"commit": commit, "dirty": bool(ask("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
