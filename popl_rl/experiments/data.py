"""The data of a run: segments, collected or loaded, and what raters say of them."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from popl_rl.config import DataConfig, EnvConfig, RatersConfig
from popl_rl.data.environments import World, make_world
from popl_rl.data.readers.imported import Imported
from popl_rl.data.readers.opening import open_data
from popl_rl.data.saved import (
    check_preferences,
    check_segments,
    load_preferences,
    load_segments,
    save_preferences,
    segments_digest,
)
from popl_rl.data.segments import collect_segments, segment_buffer, stored_segments
from popl_rl.data.store import store_path, stored
from popl_rl.experiments.asked import check_asked, write_groups
from popl_rl.experiments.behaviours import chosen_behaviours, policy_digests, ppo_raters
from popl_rl.experiments.plug_ins import plug_in_digests
from popl_rl.keys import GROUP, INFO, OBSERVATION
from popl_rl.manifest import digest_of_tensors
from popl_rl.processes import Workers
from popl_rl.randomness import stream
from popl_rl.raters.collector import collect_preferences
from popl_rl.raters.groups import RaterGroup, make_groups
from popl_rl.raters.pairs import training_pool
from popl_rl.raters.people import Raters
from popl_rl.raters.response import Response
from popl_rl.raters.values import with_values
from popl_rl.storage import save_tensordict

__all__ = [
    "Data",
    "Reader",
    "build_groups",
    "build_world",
    "describe",
    "first_segments",
    "fresh_segments",
    "given_data",
    "make_data",
]

#: Reads other people's data: path -> segments ``[N, T]`` with ``observation`` and ``action``, and
#: preferences ``[M]`` with ``pair``, ``answer`` and ``rater``.
Reader = Callable[[Path], tuple[TensorDictBase, TensorDict] | Imported]


def build_world(config: EnvConfig, *, workers: Workers | None = None) -> World:
    """The environment of a run, see ``popl_rl.data.environments.make_world``.

    Args:
        config: Settings of the environment.
        workers: Processes that step it side by side; this one if None.

    Raises:
        ValueError: If the environment cannot be resolved or built, ``env.mixture`` names behaviours
            that it does not have, or ``env.behaviours`` what cannot be found.
        TypeError: If it has no behaviours and its actions cannot be drawn at random.
    """
    is_chosen = bool(config.behaviours) or list(config.noise) != [0.0]
    return make_world(
        config.factory,
        env_id=config.id,
        options=config.options,
        data_options=config.data_options,
        mixture=config.mixture,
        choose=partial(chosen_behaviours, config) if is_chosen else None,
        workers=workers,
        features=config.features,
    )


def given_data(config: DataConfig) -> tuple[Path | None, Reader | None]:
    """Where ``data.load`` is, and what reads it; None where nothing is to be loaded, or by nobody.

    A folder of ours needs no reader.
    """
    if config.load is None:
        return None, None
    path = Path(config.load)
    if config.reader is None and not path.is_file():
        return path, None
    return path, partial(open_data, reader=config.reader, options=config.reader_options)


def build_groups(config: RatersConfig, world: World) -> tuple[RaterGroup, ...]:
    """Resolve the rater groups.

    Regret is exact where the environment has a transition table; elsewhere ``make_data`` fits the
    value of a state to each group's utility, and until then groups compare returns.

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
        preferences: TensorDict ``[M]``, see ``popl_rl.keys``.
        segment_utility: Worth of each segment to each group, ``[G, N]``; for evaluation only.
        store: Folder that the segments are kept in for all runs, if they are.
        groups: Names of the groups that were asked, in the order of ``("hidden", "group")``.
    """

    segments: TensorDictReplayBuffer
    preferences: TensorDict
    segment_utility: Tensor
    store: Path | None = None
    groups: tuple[str, ...] = ()

    @property
    def steps(self) -> TensorDictBase:
        """The segments as a TensorDict ``[N, T]``."""
        return stored_segments(self.segments)

    @cached_property
    def digests(self) -> dict[str, str]:
        """Of ``segments`` and ``preferences``, by which they are known again."""
        return {
            "segments": digest_of_tensors(self.steps)[""],
            "preferences": digest_of_tensors(self.preferences)[""],
        }

    def save(self, path: Path, *, about: Mapping[str, Any] | None = None) -> None:
        """Write segments and preferences below ``path``, replacing nothing.

        Stored segments are not written again: a link leads to them. Where preferences say which
        group each rater is of, ``about.json`` beside them says which groups these are. The
        preferences' manifest says so too, and which segments they compare.

        Args:
            path: The folder.
            about: What else the preferences' manifest says, such as the id of the run.

        Raises:
            OSError: If there is no room.
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
            # First, so that preferences are never without it.
            kept = dict(about or {})
            if GROUP in self.preferences.keys(True):
                kept["groups"] = list(self.groups)
                write_groups(path, self.groups)
            save_preferences(
                self.preferences,
                path / "preferences",
                segments=self.digests["segments"],
                about=kept,
            )


def describe(env: EnvConfig, config: DataConfig, *, seed: int) -> dict[str, Any]:
    """All that decides about the segments of a run, for ``popl_rl.data.store.store_path``."""
    names = ("factory", "id", "options", "data_options", "mixture", "max_steps")
    # A node of a larger configuration may refer to other nodes of it.
    node = env if isinstance(env, DictConfig) else OmegaConf.structured(env)
    described: Any = OmegaConf.to_container(node, resolve=True)
    described["mixture"] = described["mixture"] or None  # both are equal shares
    # Of what most worlds leave as it is, the ids of stored segments know nothing.
    chosen: dict[str, Any] = {} if env.features is None else {"features": env.features}
    if env.behaviours or list(env.noise) != [0.0]:
        chosen |= {name: described[name] for name in ("behaviours", "noise")}
        chosen |= {"policies": policy_digests(env)}
        if ppo_raters(env):
            chosen["ppo"] = {k: v for k, v in described["ppo"].items() if k != "store"}
    # A file of one's own may be changed; what is installed has a version that somebody chose.
    own = plug_in_digests(described)
    return {
        **({"plug_ins": own} if own else {}),
        "format": 1,
        "env": {**{name: described[name] for name in names}, **chosen},
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
    reader: Reader | None = None,
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
        reader: Reads ``load`` if it is no such folder.
        progress: Called with the number of segments collected so far.

    Raises:
        ValueError: If there is less data than was asked for, it does not fit the environment, or
            other groups were asked, or in another order, than ``groups``.
    """
    read = None if reader is None or load is None else _read(reader, load, config, world)
    if read is not None:
        segments, source = read[0], None
    elif load is not None:
        segments, source = _load(load / "segments", config, world), None
        if (load / "segments").is_symlink():
            source = (load / "segments").resolve()
    else:
        segments, source = _collect_or_find(config, world, env, seed=seed, progress=progress)
    if load is not None and progress is not None:
        progress(len(segments))
    memmap = None if config.memmap is None else Path(config.memmap)
    buffer = segment_buffer(segments, memmap=memmap)
    fitted = raters.label == "regret" and world.table is None
    if fitted:
        generator = stream(_data_seed(config, seed), "values")
        groups = with_values(groups, segments, generator=generator)
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    names = tuple(group.name for group in groups)
    if read is not None:
        preferences = read[1]
    elif load is not None:
        preferences = load_preferences(
            load / "preferences",
            num_segments=len(segments),
            segments=segments_digest(load / "segments", segments),
        )
        # Fitted values depend on the seed, and differ between machines.
        check_asked(load, preferences, names, None if fitted else segment_utility)
    else:
        preferences = _ask(raters, groups, buffer, segments, seed=seed)
    return Data(buffer, preferences, segment_utility, source, names)


def _data_seed(config: DataConfig, seed: int) -> int:
    """Seed of the segments."""
    return seed if config.seed is None else config.seed


def _collect_or_find(
    config: DataConfig,
    world: World,
    env: EnvConfig,
    *,
    seed: int,
    progress: Callable[[int], None] | None,
) -> tuple[TensorDictBase, Path | None]:
    """Segments that are collected, or found in the store; and where they are in it."""
    data_seed = _data_seed(config, seed)

    def collect() -> TensorDictBase:
        return _collect(config, world, env, stream(data_seed, "segments"), progress)

    if config.store is None:
        return collect(), None
    about = describe(env, config, seed=data_seed)
    name = "-".join([env.factory, *map(str, env.options.values())][:2])
    folder = stored(store_path(Path(config.store), name, about), about, collect)
    segments = _load(folder, config, world)
    if progress is not None:
        progress(len(segments))
    return segments, folder


def _ask(
    raters: RatersConfig,
    groups: tuple[RaterGroup, ...],
    buffer: TensorDictReplayBuffer,
    segments: TensorDictBase,
    *,
    seed: int,
) -> TensorDict:
    """What raters say of pairs of the segments."""
    generator = stream(seed, "raters")
    people = Raters.draw(groups, num_raters=raters.count, shares=raters.shares, generator=generator)
    preferences: TensorDict = collect_preferences(
        buffer,
        people,
        answers_per_rater=raters.answers,
        generator=generator,
        pool=training_pool(segments),
    )[:].exclude("index")
    return preferences


def _read(
    reader: Reader, path: Path, config: DataConfig, world: World
) -> tuple[TensorDictBase, TensorDict]:
    """Other people's segments and preferences, checked as ours are."""
    segments, preferences, *_ = reader(path)
    _check_segments(segments, path, config, world)
    check_segments(segments, path)
    check_preferences(preferences, path, num_segments=len(segments))
    return segments, preferences


def _load(path: Path, config: DataConfig, world: World) -> TensorDictBase:
    segments = load_segments(path, required={INFO: 0})
    _check_segments(segments, path.parent, config, world)
    if segments.shape[1] != config.length:
        raise ValueError(
            f"data.length is {config.length}, but {path.parent} holds segments of "
            f"{segments.shape[1]} steps; set data.length={segments.shape[1]}, or collect others"
        )
    return segments


def _check_segments(segments: TensorDictBase, path: Path, config: DataConfig, world: World) -> None:
    if len(segments) < config.segments:
        raise ValueError(
            f"data.segments asks for {config.segments} segments, but {path} holds "
            f"{len(segments)}; ask for fewer or collect more"
        )
    expected = world.env.observation_space.shape
    if segments[OBSERVATION].shape[2:] != expected:
        raise ValueError(
            f"{path} holds observations of shape {tuple(segments[OBSERVATION].shape[2:])}, "
            f"but the environment gives {expected}; it was collected in another environment"
        )


def first_segments(
    config: DataConfig,
    world: World,
    *,
    seed: int,
    env: EnvConfig,
    progress: Callable[[int], None] | None = None,
) -> TensorDictBase:
    """The segments that a run of this seed collects for training."""
    return _collect(config, world, env, stream(seed, "segments"), progress)


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
    how: dict[str, Any] = {"generator": generator, "progress": progress, "workers": world.workers}
    if world.collect is not None:
        return world.collect(config.segments, config.length, **how)
    return collect_segments(
        world.make_for_data,
        world.behaviours,
        num_segments=config.segments,
        length=config.length,
        shares=world.shares,
        max_steps=env.max_steps,
        **how,
    )
