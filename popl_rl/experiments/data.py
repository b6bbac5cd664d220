"""The data of a run: segments, collected or loaded, and what raters say of them."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from popl_rl.config import DataConfig, EnvConfig, RatersConfig
from popl_rl.data.environments import World
from popl_rl.data.segments import collect_segments, segment_buffer, stored_segments
from popl_rl.data.store import store_path, stored
from popl_rl.keys import ACTION, GROUP, INFO, OBSERVATION
from popl_rl.randomness import stream
from popl_rl.raters.collector import collect_preferences, load_preferences
from popl_rl.raters.groups import RaterGroup, make_groups
from popl_rl.raters.pairs import training_pool
from popl_rl.raters.people import Raters
from popl_rl.raters.response import Response
from popl_rl.raters.values import with_values
from popl_rl.storage import load_tensordict, save_tensordict

__all__ = ["Data", "build_groups", "describe", "fresh_segments", "make_data"]


def build_groups(config: RatersConfig, world: World) -> tuple[RaterGroup, ...]:
    """Resolve the rater groups.

    Regret is exact where the environment has a transition table; elsewhere :func:`make_data` fits
    the value of a state to each group's utility, and until then groups compare returns.

    Raises:
        ValueError: If a group cannot be resolved.
    """
    response = Response(
        rationality=config.response.rationality,
        mistake=config.response.mistake,
        myopia=config.response.myopia,
        tie=config.response.tie,
        skip=config.response.skip,
    )
    label = cast("Any", "return" if world.table is None else config.label)
    return make_groups(list(config.groups), label=label, table=world.table, response=response)


@dataclass(frozen=True)
class Data:
    """What the raters saw and said.

    Attributes:
        segments: Replay buffer of N segments, one item each.
        preferences: TensorDict ``[M]``, see :mod:`popl_rl.keys`.
        segment_utility: Worth of each segment to each group, ``[G, N]``; for evaluation only.
        store: Folder that the segments are kept in for all runs, if they are.
    """

    segments: TensorDictReplayBuffer
    preferences: TensorDict
    segment_utility: Tensor
    store: Path | None = None

    @property
    def steps(self) -> TensorDictBase:
        """The segments as a TensorDict ``[N, T]``."""
        return stored_segments(self.segments)

    def save(self, path: Path) -> None:
        """Write segments and preferences below ``path``, replacing nothing.

        Stored segments are not written again: a link leads to them.
        """
        segments = path / "segments"
        if not segments.exists():
            if self.store is None:
                save_tensordict(self.steps, segments)
            else:
                path.mkdir(parents=True, exist_ok=True)
                segments.unlink(missing_ok=True)  # a link that leads nowhere any more
                segments.symlink_to(os.path.relpath(self.store, path))
        if not (path / "preferences").exists():
            save_tensordict(self.preferences, path / "preferences")


def describe(env: EnvConfig, config: DataConfig, *, seed: int) -> dict[str, Any]:
    """All that decides about the segments of a run, for :func:`~popl_rl.data.store.store_path`."""
    names = ("factory", "id", "options", "data_options", "mixture", "max_steps")
    # A node of a larger configuration may refer to other nodes of it.
    node = env if isinstance(env, DictConfig) else OmegaConf.structured(env)
    described: Any = OmegaConf.to_container(node, resolve=True)
    return {
        "format": 1,
        "env": {name: described[name] for name in names},
        "segments": config.segments,
        "length": config.length,
        "seed": seed,
    }


def make_data(
    config: DataConfig,
    raters: RatersConfig,
    world: World,
    groups: tuple[RaterGroup, ...],
    *,
    seed: int,
    env: EnvConfig,
    load: Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> Data:
    """Collect segments and ask the raters, or load what an earlier run collected.

    Args:
        config: Segments to collect.
        raters: Raters to ask.
        world: Where segments come from.
        groups: Rater groups.
        seed: Seed of the run.
        env: What the world was built from.
        load: Folder to load from instead.
        progress: Called with the number of segments collected so far.

    Raises:
        ValueError: If there is less data than was asked for, or it does not fit the environment.
    """
    data_seed = seed if config.seed is None else config.seed
    source, folder = None, None if load is None else load / "segments"
    if load is None:

        def collect() -> TensorDictBase:
            return _collect(config, world, env, stream(data_seed, "segments"), progress)

        if config.store is None:
            segments = collect()
        else:
            about = describe(env, config, seed=data_seed)
            name = "-".join([env.factory, *map(str, env.options.values())][:2])
            path = store_path(Path(config.store), name, about)
            folder = source = stored(path, about, collect)
    elif (load / "segments").is_symlink():
        source = (load / "segments").resolve()
    if folder is not None:
        segments = _load(folder, config, world)
        if progress is not None:
            progress(len(segments))
    memmap = None if config.memmap is None else Path(config.memmap)
    buffer = segment_buffer(segments, memmap=memmap)
    if raters.label == "regret" and world.table is None:
        groups = with_values(groups, segments, generator=stream(data_seed, "values"))
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    if load is None:
        generator = stream(seed, "raters")
        people = Raters.draw(
            groups, num_raters=raters.count, shares=raters.shares, generator=generator
        )
        preferences = collect_preferences(
            buffer,
            people,
            answers_per_rater=raters.answers,
            generator=generator,
            pool=training_pool(segments),
        )[:].exclude("index")
    else:
        preferences = load_preferences(load / "preferences", num_segments=len(segments))
        group = preferences.get(GROUP, None)
        if group is not None and int(group.max()) >= len(groups):
            raise ValueError(
                f"{load} holds preferences of {int(group.max()) + 1} groups, but raters.groups "
                f"names {len(groups)}; name the groups that were asked then"
            )
    return Data(buffer, preferences, segment_utility, source)


def _load(path: Path, config: DataConfig, world: World) -> TensorDictBase:
    segments = load_tensordict(path, required={OBSERVATION: 3, ACTION: 2, INFO: 0})
    if len(segments) < config.segments:
        raise ValueError(
            f"data.segments asks for {config.segments} segments, but {path.parent} holds "
            f"{len(segments)}; ask for fewer or collect more"
        )
    expected = world.env.observation_space.shape
    if segments[OBSERVATION].shape[2:] != expected:
        raise ValueError(
            f"{path.parent} holds observations of shape {tuple(segments[OBSERVATION].shape[2:])}, "
            f"but the environment gives {expected}; it was collected in another environment"
        )
    segments.auto_batch_size_(2)
    return segments


def fresh_segments(
    config: DataConfig, world: World, *, seed: int, env: EnvConfig
) -> TensorDictBase:
    """As many segments as were collected for training, that nobody has seen."""
    return _collect(config, world, env, stream(seed, "fresh segments"), None)


def _collect(
    config: DataConfig,
    world: World,
    env: EnvConfig,
    generator: torch.Generator,
    progress: Callable[[int], None] | None,
) -> TensorDictBase:
    if world.collect is not None:
        return world.collect(config.segments, config.length, generator=generator, progress=progress)
    return collect_segments(
        world.make_for_data,
        world.behaviours,
        num_segments=config.segments,
        length=config.length,
        generator=generator,
        shares=world.shares,
        max_steps=env.max_steps,
        progress=progress,
    )
