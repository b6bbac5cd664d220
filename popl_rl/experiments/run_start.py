"""How a run begins: everything is looked at, then the folder appears with its first content."""

import logging
import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from popl_rl.config import Config, changed, plain, validate
from popl_rl.experiments.preflight import Place, survey
from popl_rl.experiments.run_folder import (
    create_run_dir,
    in_use,
    save_config,
    write_metadata,
)
from popl_rl.experiments.run_manifest import container, load_run_config, write_run_manifest
from popl_rl.interruption import Terminated
from popl_rl.memory import keep_freed_memory
from popl_rl.processes import Workers, workers_for

__all__ = ["kept_unless_refused", "open_run"]


@contextmanager
def open_run(
    config: Config, *, command: Sequence[str], given: Sequence[str] = ()
) -> Iterator[tuple[Config, Path, Place | None]]:
    """Make the folder of a run, or find the one to continue with its own settings, and hold it.

    Args:
        config: Settings that were checked; of a run that is continued, where it is.
        command: What was typed, for ``metadata.json``.
        given: Overrides that were typed; of those beside ``resume=`` a run that is continued takes
            the ones that ``popl_rl.config.CHANGEABLE`` allows.

    Yields:
        The settings, the folder, on which no other process works meanwhile, and where the run takes
        place; no place where people's answers are learnt from without simulated raters.

    Raises:
        ValueError: If the settings of the run that is continued are off or were changed, or
            something that they name cannot be found or does not go together.
        HeldError: If another process works on the run.
        OSError: If the folder exists already, or there is no run to resume.
    """
    if config.resume is not None:
        run_dir = create_run_dir(Path(config.resume), name="", resume=True)
        with in_use(run_dir), _saying_how_to_go_on(run_dir, command):
            config = _continued(config, run_dir, given)
            with workers_for(config.workers, threads=config.threads) as workers:
                place = _prepared(config, workers)
                write_metadata(run_dir, command=command)
                yield config, run_dir, place
        return
    with workers_for(config.workers, threads=config.threads) as workers:
        place = _prepared(config, workers)
        with _new_run(config, command) as run_dir:
            yield config, run_dir, place


@contextmanager
def _new_run(config: Config, command: Sequence[str]) -> Iterator[Path]:
    """Make the folder of a run, and hold it."""

    def fill(folder: Path) -> None:
        settings = container(config)  # once for both
        write_run_manifest(folder, settings)
        save_config(folder, settings)
        write_metadata(folder, command=command)

    name = f"{config.method.name}-seed{config.seed}"
    wanted = None if config.run_dir is None else Path(config.run_dir)
    run_dir = create_run_dir(wanted, name=name, fill=fill)
    with in_use(run_dir), _saying_how_to_go_on(run_dir, command):
        yield run_dir


@contextmanager
def _saying_how_to_go_on(run_dir: Path, command: Sequence[str]) -> Iterator[None]:
    """Note at Ctrl-C and SIGTERM which command goes on with the run."""
    try:
        yield
    except (KeyboardInterrupt, Terminated) as stop:
        name = Path(command[0]).name if command else ""
        program = name if name.startswith("popl-") else "popl-train"
        stop.add_note(f"continue with: {program} resume={shlex.quote(str(run_dir))}")
        raise


def _continued(config: Config, run_dir: Path, given: Sequence[str]) -> Config:
    """The settings of a run that is continued, with what may change."""
    stored: Any = OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run_dir))
    asked = OmegaConf.structured(config)
    for name in changed(given):
        OmegaConf.update(stored, name, OmegaConf.select(asked, name))
    found: Config = plain(stored)
    validate(found)
    return found


def _prepared(config: Config, workers: Workers | None) -> Place | None:
    """Where the run takes place, after this process was told how it is to compute."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # TorchRL sets its own when imported
    torch.set_num_threads(config.threads)
    keep_freed_memory()
    return survey(config, workers=workers)


@contextmanager
def kept_unless_refused(run_dir: Path, *, is_new: bool) -> Iterator[None]:
    """Remove a new run's folder if the block refuses what was asked for.

    So that nothing stands in the way of the corrected command. A full disk or a kill is no refusal.

    Args:
        run_dir: Folder of the run.
        is_new: Whether it began with this process; a run that is resumed keeps its folder.

    Raises:
        TypeError: What the block raises.
        ValueError: Likewise.
    """
    try:
        yield
    except (TypeError, ValueError):
        if is_new:
            shutil.rmtree(run_dir, ignore_errors=True)
        raise
