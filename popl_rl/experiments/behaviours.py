"""Behaviours of the data that settings name: functions, saved policies, PPO, random actions.

``env.behaviours`` lists references, ``env.noise`` at which levels of noise each of them acts:

- ``random``: uniformly random actions;
- ``ppo:<rater>``: a policy that PPO has trained on a group's utility, see ``ppo_policies``;
- ``policy:<folder>``: a saved policy set, every member, or one: ``policy:<folder>#3``;
- ``policy:<file>.zip``: a policy of Stable-Baselines3, where that is installed;
- a name, or a pattern of names, of the environment's own behaviours;
- any other reference: a function ``f(step, generator) -> actions``, or an actor of TorchRL.
"""

import fnmatch
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import gymnasium
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from popl_rl.config import EnvConfig
from popl_rl.data.adapters import adapt_behaviour, native_spaces
from popl_rl.data.behaviours import Behaviour, random_behaviour
from popl_rl.data.environments import World
from popl_rl.data.plugged import checked_behaviour
from popl_rl.experiments.ppo_policies import check_ppo, ppo_policy
from popl_rl.keys import ACTION, OBSERVATION
from popl_rl.manifest import digest_of_bytes
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.registry import resolve

__all__ = ["chosen_behaviours", "policy_digests", "ppo_raters"]

_PPO, _POLICY = "ppo:", "policy:"


def chosen_behaviours(env: EnvConfig, world: World) -> dict[str, Behaviour]:
    """The behaviours that settings name, by name, each at every level of noise.

    Without noise a behaviour is called as what it is; with a level of 0.3, ``<name>~0.3``.

    Args:
        env: Settings of the environment.
        world: The environment, with its own behaviours, if any.

    Raises:
        ValueError: If a reference leads nowhere, or to something that does not act here.
        TypeError: If it names something else, or noise cannot be drawn for the actions.
    """
    if world.collect is not None:
        raise ValueError(
            f"env.behaviours and env.noise have no use in env {env.factory!r}, which collects its "
            "segments itself (collect_segments); leave them out"
        )
    found: dict[str, Behaviour] = {}
    for reference in env.behaviours or list(world.behaviours):
        for name, behaviour in _find(reference, env, world).items():
            if name in found:
                raise ValueError(
                    f"env.behaviours: {reference!r} gives a second behaviour {name!r}; behaviours "
                    "need different names"
                )
            found[name] = behaviour
    space = world.env.action_space
    return {
        _noisy_name(name, level): _Noisy(behaviour, level, space) if level else behaviour
        for name, behaviour in (found or {"random": random_behaviour(space)}).items()
        for level in ([0.0] if name == "random" else env.noise)
    }


def ppo_raters(env: EnvConfig) -> list[str]:
    """References of the rater groups that PPO is trained on for the data."""
    return [one.removeprefix(_PPO) for one in env.behaviours if one.startswith(_PPO)]


def policy_digests(env: EnvConfig) -> dict[str, str]:
    """Digest of each saved policy that settings name, by its reference."""
    digests = {}
    for reference in env.behaviours:
        if reference.startswith(_POLICY):
            path = Path(reference.removeprefix(_POLICY).partition("#")[0])
            about = path / "policy_set.json" if path.is_dir() else path
            digests[reference] = digest_of_bytes(about.read_bytes())
    return digests


def _noisy_name(name: str, level: float) -> str:
    return f"{name}~{level:g}" if level else name


def _find(reference: str, env: EnvConfig, world: World) -> dict[str, Behaviour]:
    """What a reference names: one behaviour, or several."""
    own = fnmatch.filter(world.behaviours, reference)
    if own:
        return {name: world.behaviours[name] for name in own}
    if reference == "random":
        return {reference: random_behaviour(world.env.action_space)}
    if reference.startswith(_PPO):
        rater = reference.removeprefix(_PPO)
        resolve("rater", rater)
        check_ppo(f"env.behaviours: {reference!r}", world.env)
        return {_PPO + rater.rpartition(":")[2]: _Trained(env, rater, world)}
    if reference.startswith(_POLICY):
        return _saved(reference, world.env)
    function = resolve("behaviour", reference)
    name = reference.rpartition(":")[2]
    if isinstance(function, TensorDictModuleBase):
        return {name: _Actor(function)}
    native = native_spaces(world.env)[1]
    checked = checked_behaviour(function, env.factory, name, native)
    return {name: adapt_behaviour(checked, native)}


def _saved(reference: str, env: gymnasium.Env[Any, Any]) -> dict[str, Behaviour]:
    """Policies from disk."""
    place, _, number = reference.removeprefix(_POLICY).partition("#")
    path = Path(place).expanduser()
    if path.suffix == ".zip" and path.is_file():
        return {f"{_POLICY}{path.stem}": _stable_baselines(reference, path, env)}
    if not path.is_dir():
        raise ValueError(
            f"env.behaviours: {reference!r} must name the folder of a policy set, such as "
            f"{_POLICY}runs/mine/policies, perhaps with a member, #3, or a .zip of "
            "Stable-Baselines3, which exists; give an actor of TorchRL as my.py:actor"
        )
    try:
        policies = PolicySet.load(path)
    except FileNotFoundError as error:
        raise ValueError(f"env.behaviours: {reference!r}: {error}") from error
    spec, fitting = cast("PolicySpec", policies.population.spec), PolicySpec.from_env(env)
    kinds = [(one.observation_dim, one.action_dim, one.discrete) for one in (spec, fitting)]
    if kinds[0] != kinds[1]:
        raise ValueError(f"env.behaviours: {reference!r} is of {spec}; here acts {fitting}")
    members = [str(one) for one in range(len(policies))]
    if number and number not in members:
        raise ValueError(
            f"env.behaviours: {reference!r} must name one of members 0 to {members[-1]}"
        )
    moved = fitting.first_action - spec.first_action
    # A run's set is in a folder that is called as that of any other run.
    name = path.resolve().parent.name if path.name == PolicySet.folder else path.name
    return {
        f"{_POLICY}{name}#{one}": _Member(policies, int(one), moved)
        for one in ([number] if number else members)
    }


def _stable_baselines(reference: str, path: Path, env: gymnasium.Env[Any, Any]) -> Behaviour:
    """A policy that Stable-Baselines3 has saved, whatever the algorithm."""
    if find_spec("stable_baselines3") is None:
        raise ValueError(
            f"env.behaviours: {reference!r} needs Stable-Baselines3: pip install stable-baselines3"
        )
    from stable_baselines3.common.save_util import load_from_zip_file

    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu")
        policy = data["policy_class"](
            data["observation_space"],
            data["action_space"],
            lambda _: 0.0,  # a learning rate, of which acting has no need
            **data.get("policy_kwargs", {}),
        )
        policy.load_state_dict(parameters["policy"])
    except Exception as error:
        raise ValueError(
            f"env.behaviours: {reference!r} cannot be read by Stable-Baselines3: {error!r}"
        ) from error
    spaces = (
        (data["observation_space"], env.observation_space),
        (data["action_space"], env.action_space),
    )
    if any(_size(theirs) != _size(ours) for theirs, ours in spaces):
        raise ValueError(
            f"env.behaviours: {reference!r} acts in {data['observation_space']} by "
            f"{data['action_space']}; here are {env.observation_space} and {env.action_space}"
        )
    return lambda step, _: torch.as_tensor(
        policy.predict(step[OBSERVATION].numpy(), deterministic=True)[0]
    )


def _size(space: gymnasium.Space[Any]) -> tuple[Any, ...]:
    return space.shape, getattr(space, "n", None)


@dataclass(frozen=True)
class _Member:
    """A policy of a set, at what is random in it."""

    policies: PolicySet
    member: int
    moved: int = 0  # from the set's actions to the environment's

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        seen = step[OBSERVATION]
        return self.moved + self.policies.act(seen, member=self.member, generator=generator)


class _Trained:
    """What PPO learns from a rater's utility, once it is needed."""

    def __init__(self, env: EnvConfig, rater: str, world: World) -> None:
        self.env, self.rater, self.make = env, rater, world.make
        self._policy: _Member | None = None

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        if self._policy is None:
            self._policy = _Member(ppo_policy(self.env, self.rater, self.make), 0)
        return self._policy(step, generator)


@dataclass(frozen=True)
class _Actor:
    """An actor of TorchRL, without exploration."""

    actor: TensorDictModuleBase

    @torch.no_grad()
    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:  # noqa: ARG002
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action: Tensor = self.actor(step.select(OBSERVATION))[ACTION]
        return action


class _Noisy:
    """A behaviour with noise: now and then a random action; on vectors, Gaussian noise.

    Args:
        behaviour: What is disturbed.
        level: Chance of a random action at each step. Of a ``Box``: standard deviation of the
            noise, in halves of the range between its bounds; in units of the action without bounds.
        space: The actions.
    """

    def __init__(self, behaviour: Behaviour, level: float, space: gymnasium.Space[Any]) -> None:
        self.behaviour, self.level = behaviour, level
        self.drawn: Behaviour | None = None
        self.scale = torch.ones(())
        if not isinstance(space, gymnasium.spaces.Box):
            if level > 1:
                raise ValueError(
                    f"env.noise must be chances in [0, 1] where actions are {space}, got {level:g}"
                )
            self.drawn = random_behaviour(space)
        elif space.is_bounded():
            self.scale = torch.as_tensor((space.high - space.low) / 2).float()

    def reset(self) -> None:
        """Begin episodes, if the behaviour wants to know."""
        if hasattr(self.behaviour, "reset"):
            self.behaviour.reset()

    def __call__(self, step: TensorDictBase, generator: torch.Generator) -> Tensor:
        action = self.behaviour(step, generator)
        if self.drawn is None:
            noise = torch.randn(action.shape, generator=generator)
            return action + self.level * self.scale * noise
        slips = torch.rand(action.shape, generator=generator) < self.level
        return torch.where(slips, self.drawn(step, generator), action)
