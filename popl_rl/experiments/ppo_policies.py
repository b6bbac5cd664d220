"""Policies that PPO has trained on what rater groups want, kept on disk for all runs.

A reference for verdicts, and behaviours of the data: the best known where no table can be planned
in. They depend on the environment, the raters and ``env.ppo`` alone, not on a run or its seed.
"""

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import torch
from omegaconf import DictConfig, OmegaConf

from popl_rl.config import EnvConfig, PPOSettings, plain
from popl_rl.data.environments import counting_from_zero, is_stateless
from popl_rl.data.store import store_path
from popl_rl.evaluation.ppo import train_ppo
from popl_rl.experiments.plug_ins import plug_in_digests
from popl_rl.experiments.progress import Progress, in_words, is_told
from popl_rl.locks import locked
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.randomness import stream
from popl_rl.raters.groups import make_groups

__all__ = ["check_ppo", "ppo_policies", "ppo_policy", "tell_cost"]

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]

_HIDDEN = (64, 64)  # units of the policies
_TRIAL = 64  # steps, at most, of the episodes that are timed


def check_ppo(name: str, env: gymnasium.Env[Any, Any]) -> None:
    """Raise unless PPO can act in an environment.

    Args:
        name: The setting that asks for it.
        env: The environment.

    Raises:
        ValueError: If there is nothing to do, or the spaces are of another kind.
    """
    if is_stateless(env):
        raise ValueError(f"{name} must be left out where there is a single action: PPO has no use")
    try:
        PolicySpec.from_env(env)
    except TypeError as error:
        raise ValueError(f"{name} needs an environment in which PPO can act: {error}") from error


def tell_cost(env: EnvConfig, raters: Sequence[str], make: MakeEnv) -> None:
    """Say on stderr what training the policies that are not on disk yet will take.

    Args:
        env: Settings of the environment.
        raters: References of the groups.
        make: Builds an environment.
    """
    missing = [name for name in dict.fromkeys(raters) if not _folder(env, name).is_dir()]
    if not missing or not is_told():
        return
    frames = len(missing) * env.ppo.frames
    seconds = frames * _seconds_per_step(env, make)
    sys.stderr.write(
        f"PPO will train on what {', '.join(missing)} want: {frames} steps, "
        f"{in_words(seconds)}; kept in {env.ppo.store} for other runs\n"
    )
    sys.stderr.flush()


def ppo_policies(env: EnvConfig, raters: Sequence[str], make: MakeEnv) -> PolicySet:
    """A policy for each of G groups, see ``ppo_policy``."""
    found = [ppo_policy(env, rater, make) for rater in raters]
    spec: Any = found[0].population.spec
    return PolicySet(Population([one.population.network(0) for one in found], spec))


def ppo_policy(env: EnvConfig, rater: str, make: MakeEnv) -> PolicySet:
    """A policy that PPO has trained on the utility of a group: from disk, or trained now.

    Args:
        env: Settings of the environment, ``env.ppo`` among them.
        rater: Reference of the group.
        make: Builds an environment.

    Returns:
        A set of one.

    Raises:
        ValueError: If what is on disk is damaged, or the utility fails.
    """
    path = _folder(env, rater)
    with locked(path):
        if not path.is_dir():
            _train(env, rater, make).save(path, provenance={"rater": rater})
        return PolicySet.load(path)


def _folder(env: EnvConfig, rater: str) -> Path:
    """Where the policy of a group is: other settings or files, another folder."""
    node = env if isinstance(env, DictConfig) else OmegaConf.structured(env)
    described: Any = OmegaConf.to_container(node, resolve=True)
    about = {name: described[name] for name in ("factory", "id", "options", "max_steps")}
    about |= {"format": 1, "rater": rater, "hidden": list(_HIDDEN)}
    if env.features is not None:
        about["features"] = env.features
    about["ppo"] = {name: value for name, value in described["ppo"].items() if name != "store"}
    about["plug_ins"] = plug_in_digests(about)
    name = "-".join(filter(None, (env.factory.rpartition(":")[2], env.id, rater)))
    return store_path(Path(env.ppo.store), name, about)


def _train(env: EnvConfig, rater: str, make: MakeEnv) -> PolicySet:
    settings = plain(env).ppo
    (group,) = make_groups([rater], label="return")
    with Progress(f"PPO for {group.name}", total=settings.frames) as progress:

        def on_batch(frames: int, returned: float) -> None:
            progress.update(min(frames, settings.frames), mean_return=returned)

        trained = train_ppo(
            lambda: counting_from_zero(make()),
            group.step_utility,
            _spec(settings, counting_from_zero(make())),
            frames=settings.frames,
            max_steps=env.max_steps,
            tells=True,
            discount=settings.discount,
            learning_rate=settings.learning_rate,
            generator=stream(0, f"ppo/{rater}"),
            progress=on_batch,
        )
    return PolicySet(Population([trained.network(0)], _spec(settings, make())))


def _spec(settings: PPOSettings, env: gymnasium.Env[Any, Any]) -> PolicySpec:
    return PolicySpec.from_env(env, hidden=_HIDDEN, action_std=settings.action_std)


def _seconds_per_step(env: EnvConfig, make: MakeEnv) -> float:
    """Seconds that a step and learning from it take."""
    begun, taken = [], []
    spec = _spec(plain(env).ppo, counting_from_zero(make()))
    for _ in range(2):  # the first time, much is loaded
        begun.append(time.perf_counter())
        train_ppo(
            lambda: counting_from_zero(make()),
            lambda steps: torch.zeros(steps.batch_size),
            spec,
            frames=1,
            frames_per_batch=512,
            max_steps=min(env.max_steps, _TRIAL),
            tells=True,
            generator=torch.Generator().manual_seed(0),
            progress=lambda frames, _: taken.append(frames),
        )
    return (time.perf_counter() - begun[-1]) / taken[-1]
