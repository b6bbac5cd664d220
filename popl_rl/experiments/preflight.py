"""What is looked at before a run has a folder: the world, the raters, and how all goes together.

Mistakes that need more than the settings to be seen are told here, within seconds, and leave
nothing behind that would stand in the way of the corrected command.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase

from popl_rl.algorithms.assembly import find_rule
from popl_rl.config import Config, EnvConfig
from popl_rl.data.behaviours import random_behaviour
from popl_rl.data.environments import World
from popl_rl.data.rollouts import lockstep, numeric_info
from popl_rl.experiments.builders import build_spec, check_baselines
from popl_rl.experiments.data import build_groups, build_world
from popl_rl.experiments.ppo_policies import check_ppo
from popl_rl.keys import INFO
from popl_rl.models.sets import load_set
from popl_rl.plug_ins import located
from popl_rl.processes import Workers
from popl_rl.raters.groups import RaterGroup
from popl_rl.registry import resolve

__all__ = ["Place", "check_device", "check_infos", "survey"]

#: Names of successes that settings name by convention, whether an environment tells of it or not.
_USUAL = ("", "goal", "success")
#: Steps of the random episode that is looked at.
_STEPS = 200


@dataclass(frozen=True)
class Place:
    """Where a run takes place, and for whom.

    Attributes:
        world: Environment.
        groups: G hidden groups.
    """

    world: World
    groups: tuple[RaterGroup, ...]


def survey(config: Config, *, workers: Workers | None = None) -> Place | None:
    """Build the world, ask the raters about a random episode, and check what needs them.

    Args:
        config: Settings that were checked by themselves.
        workers: Processes that step the world side by side; this one if None.

    Returns:
        The place; None where people's answers are learnt from without simulated raters.

    Raises:
        ValueError: If something cannot be found, built, called, or does not go together.
        TypeError: If a plug-in gives something of another kind.
    """
    check_device(config.device)
    _check_references(config)
    if not config.raters.groups:
        return None
    world = build_world(config.env, workers=workers)
    try:
        groups = build_groups(config.raters, world)
        _check_fit(groups, world.env)
        episode = _random_episode(world, config.env.max_steps)
        for group in groups:
            _check_rater(group, episode)
        _check_constant_infos(config.env, world, episode)
        _check_lengths(config, world)
        if config.evaluation.ppo_reference:
            check_ppo("evaluation.ppo_reference", world.env)
        spec = build_spec(config.method, world.env)
        if config.evaluation.baselines and config.evaluation.baselines_from is not None:
            path = config.evaluation.baselines_from
            check_baselines(load_set(path), path, spec, len(groups))
    except BaseException:
        world.env.close()
        raise
    return Place(world, groups)


def check_device(device: str) -> None:
    """Raise unless there is such a device.

    Raises:
        ValueError: If this machine, or this build of PyTorch, has none.
    """
    if device == "cpu":
        return
    number = int(device.partition(":")[2] or 0)
    if not torch.cuda.is_available():
        build = f"PyTorch {torch.__version__}"
        raise ValueError(f"device={device} needs CUDA, which {build} does not find; set device=cpu")
    if number >= torch.cuda.device_count():
        last = torch.cuda.device_count() - 1
        raise ValueError(f"device={device} is not there: devices are cuda:0 to cuda:{last}")


def _check_references(config: Config) -> None:
    """Raise for what cannot be resolved, before the world is built."""
    resolve("env", config.env.factory)
    resolve("method", config.method.factory)
    if "popl" in config.method.sections():
        find_rule(config.method.popl.selection, tournament=config.method.popl.tournament)
    for group in config.raters.groups:
        resolve("rater", group)
    if config.data.reader is not None:
        resolve("reader", config.data.reader)


def _check_fit(groups: Sequence[RaterGroup], env: gymnasium.Env[Any, Any]) -> None:
    """Raise if raters say that the environment lacks what they want."""
    for group in groups:
        fits = getattr(group.utility, "fits", None)
        against = None if fits is None else fits(env.unwrapped)
        if against is not None:
            raise ValueError(f"raters.groups: {group.name!r} has no place here: {against}")


def _check_rater(group: RaterGroup, episode: TensorDictBase) -> None:
    """Raise if a rater changes what it is shown, or changes its mind."""
    shown = episode.clone()
    utility = group.step_utility(shown)
    with located(group.utility):
        if not bool((shown == episode).all()):
            raise ValueError(
                f"rater {group.name!r} must leave segments as they are, but changed them; work on "
                "a copy, as in segments['action'].clone()"
            )
        if not torch.equal(utility, group.step_utility(shown)):
            raise ValueError(
                f"rater {group.name!r} must give the same utility each time, but a second call "
                "differed; leave randomness to raters.response"
            )


def _random_episode(world: World, max_steps: int) -> TensorDictBase:
    """An episode ``[1, H]`` of random actions, or of the first behaviour where these do not do."""
    try:
        behaviour = random_behaviour(world.env.action_space)
    except TypeError:
        behaviour = next(iter(world.behaviours.values()))
    generator = torch.Generator().manual_seed(0)
    return lockstep(
        [world.env],
        lambda step: behaviour(step, generator),
        seeds=[0],
        max_steps=min(max_steps, _STEPS),
    )


def check_infos(env: EnvConfig, known: Iterable[str]) -> None:
    """Raise if settings name numbers that infos lack.

    Args:
        env: The settings.
        known: Names of the numbers in infos.

    Raises:
        ValueError: If one is missing; a success of a usual name may be.
    """
    known = sorted(known)
    wanted = {"env.measured": list(env.measured)}
    wanted["env.door"] = [] if env.door is None else [env.door]
    wanted["env.success"] = [] if env.success in _USUAL else [env.success]
    missing = [f"{name}={key}" for name, keys in wanted.items() for key in keys if key not in known]
    if missing:
        raise ValueError(
            f"{', '.join(missing)}: no such number is in the environment's info, which has "
            f"{', '.join(known) or 'none'}"
        )


def _check_constant_infos(env: EnvConfig, world: World, episode: TensorDictBase) -> None:
    """Check names of infos in an environment whose infos have the same ones everywhere.

    Others may tell of some things only when they happen; the data show.
    """
    known = list(map(str, episode[INFO].keys()))
    _, first = world.env.reset(seed=0)
    if set(known) == numeric_info(first).keys():
        check_infos(env, known)


def _check_lengths(config: Config, world: World) -> None:
    """Raise if segments are longer than episodes, or more than this machine's memory holds."""
    data, env = config.data, config.env
    if data.load is not None:
        return
    if world.collect is None and data.length > env.max_steps:
        raise ValueError(
            f"data.length must not exceed the length of an episode, env.max_steps={env.max_steps}, "
            f"got {data.length}: choose shorter segments"
        )
    shape = getattr(world.env.observation_space, "shape", None) or (1,)
    needed = 4 * data.segments * data.length * int(torch.tensor(shape).prod())
    held = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > held and data.memmap is None:
        raise ValueError(
            f"data.segments={data.segments} of data.length={data.length} take "
            f"{needed / 2**30:.0f} GiB for their observations alone, and this machine has "
            f"{held / 2**30:.0f} GiB; collect fewer, or set data.memmap"
        )
    if config.data.store is not None and Path(config.data.store).is_file():
        raise ValueError(f"data.store must be a folder, got the file {config.data.store}")
