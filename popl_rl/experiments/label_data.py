"""Segments for people to compare: copied, read, or collected first."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import cast

from popl_rl.config import DataConfig, EnvConfig, load_config
from popl_rl.experiments.data import Reader, build_world, first_segments
from popl_rl.manifest import read_json
from popl_rl.registry import resolve
from popl_rl.storage import save_tensordict, write_json, written_beside

__all__ = ["gather_segments"]

_TEXTS = "texts.json"


def gather_segments(
    config: DataConfig,
    env: EnvConfig,
    folder: Path,
    *,
    seed: int,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Put segments into a folder, unless they are there.

    Args:
        config: What to load or how much to collect.
        env: Where to collect.
        folder: Gets ``segments``, ``texts.json`` if what is loaded has it, and ``label.json``.
        seed: Of what is collected.
        progress: Called with the number of segments collected so far.

    Returns:
        The seed by which these segments were collected, as far as it is known.

    Raises:
        ValueError: As the reader, or collecting, does.
    """
    about = folder / "label.json"
    if about.is_file():
        return int(read_json(about, cure="move the folder away, or restore the file")["seed"])
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / "segments", ignore_errors=True)  # left by a killed process
    seed = seed if config.seed is None else config.seed
    if config.load is not None and config.reader is not None:
        reader = cast("Reader", resolve("reader", config.reader))
        save_tensordict(reader(Path(config.load))[0], folder / "segments")
    elif config.load is not None:
        source = Path(config.load)
        with written_beside(folder / "segments") as beside:
            shutil.copytree((source / "segments").resolve(), beside, dirs_exist_ok=True)
        if (source / _TEXTS).is_file():
            shutil.copyfile(source / _TEXTS, folder / _TEXTS)
        if (source.parent / "config.yaml").is_file():
            run = load_config(source.parent)
            seed = run.seed if run.data.seed is None else run.data.seed
    else:
        segments = first_segments(config, build_world(env), seed=seed, env=env, progress=progress)
        save_tensordict(segments, folder / "segments")
    write_json(about, {"seed": seed})
    return seed
