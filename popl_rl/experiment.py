"""From a configuration to the objects of a run. Configuration objects go no further than here."""

import fnmatch
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from popl_rl.comparisons import Comparisons
from popl_rl.config import DataConfig, EnvConfig, MethodConfig, RatersConfig, parse_epsilon
from popl_rl.keys import ACTION, GROUP, INFO, OBSERVATION
from popl_rl.losses import CPLLoss
from popl_rl.planning import Table
from popl_rl.policies import PolicySpec
from popl_rl.policy_set import PolicySet
from popl_rl.popl import POPL
from popl_rl.population import Population
from popl_rl.preferences import collect_preferences, load_preferences
from popl_rl.raters import RaterGroup, Raters, Response, make_groups
from popl_rl.registry import resolve
from popl_rl.segments import (
    Behaviour,
    SegmentBank,
    collect_segments,
    load_tensordict,
    random_behaviour,
    save_tensordict,
    segment_buffer,
    stored_segments,
    table_behaviour,
)
from popl_rl.teams import TeamPOPL, TeamSettings
from popl_rl.variation import GaussianHead, GradientCPL

__all__ = [
    "Data",
    "World",
    "behaviour_shares",
    "build_groups",
    "build_popl",
    "build_world",
    "final_policies",
    "generations_of",
    "make_data",
    "stream",
    "variation_of",
]

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]


def stream(seed: int, name: str, device: torch.device | str = "cpu") -> torch.Generator:
    """An independent source of randomness for one purpose of a run.

    Each purpose has its own, so that asking for more of one thing changes nothing else.
    """
    return torch.Generator(device).manual_seed(zlib.crc32(f"{seed}/{name}".encode()))


@dataclass(frozen=True)
class World:
    """An environment and what it offers.

    Attributes:
        make: Builds an environment to act in.
        make_for_data: Builds an environment to collect segments in.
        env: One environment, for its spaces and its picture.
        behaviours: What the data shows.
        shares: Share of each behaviour in the data.
        table: Exact model, if the environment exposes one.
    """

    make: MakeEnv
    make_for_data: MakeEnv
    env: gymnasium.Env[Any, Any]
    behaviours: Mapping[str, Behaviour]
    shares: Mapping[str, float]
    table: Table | None


def build_world(config: EnvConfig) -> World:
    """Resolve an environment and read off what it offers.

    An environment is any Gymnasium environment. Two methods are used if it has them:
    ``transition_table()`` (exact regret labels) and ``behaviours()`` (what the data shows: by
    name, tables ``[S, A]`` of action probabilities or functions; uniformly random otherwise).

    Raises:
        ValueError: If the environment cannot be resolved or built, or ``mixture`` names behaviours
            that it does not have.
        TypeError: If it has no behaviours and its actions cannot be drawn at random, see
            :func:`~popl_rl.segments.random_behaviour`.
    """
    factory = cast("Callable[..., gymnasium.Env[Any, Any]]", resolve("env", config.factory))
    leading = () if config.id is None else (config.id,)

    def build(options: dict[str, Any]) -> gymnasium.Env[Any, Any]:
        try:
            env = factory(*leading, **options)
        except (TypeError, gymnasium.error.Error) as error:
            raise ValueError(
                f"env.factory {config.factory!r} cannot be built with id {config.id!r} and options "
                f"{options}: {error}"
            ) from error
        if not isinstance(env, gymnasium.Env):
            raise ValueError(
                f"env.factory {config.factory!r} must return a gymnasium.Env, got {type(env)}"
            )
        if isinstance(env.action_space, gymnasium.spaces.Box):
            # A Gaussian policy's mean knows no bounds. Gymnasium's own ClipAction would hide the
            # bounds, which random actions need.
            clip = partial(np.clip, a_min=env.action_space.low, a_max=env.action_space.high)
            env = gymnasium.wrappers.TransformAction(env, clip, env.action_space)
        return env

    def make() -> gymnasium.Env[Any, Any]:
        return build(dict(config.options))

    def make_for_data() -> gymnasium.Env[Any, Any]:
        return build({**config.options, **config.data_options})

    env = make()
    inner = env.unwrapped
    table = inner.transition_table() if hasattr(inner, "transition_table") else None
    given = inner.behaviours() if hasattr(inner, "behaviours") else {}
    behaviours = {
        name: table_behaviour(what) if isinstance(what, Tensor) else what
        for name, what in given.items()
    } or {"random": random_behaviour(env.action_space)}
    shares = behaviour_shares(list(behaviours), config.mixture)
    return World(make, make_for_data, env, behaviours, shares, table)


def behaviour_shares(names: Sequence[str], mixture: Mapping[str, float] | None) -> dict[str, float]:
    """Share of each behaviour in the data.

    Args:
        names: Behaviours that there are.
        mixture: Shares by name or by pattern (``"planner/*"``), which the matching behaviours
            divide equally; None for equal shares of all.

    Raises:
        ValueError: If a pattern matches nothing.
    """
    if mixture is None:
        return dict.fromkeys(names, 1 / len(names))
    shares = dict.fromkeys(names, 0.0)
    for pattern, share in mixture.items():
        matching = fnmatch.filter(names, pattern)
        if not matching:
            raise ValueError(
                f"env.mixture {pattern!r} matches no behaviour; there are {', '.join(names)}"
            )
        for name in matching:
            shares[name] += share / len(matching)
    return shares


def build_groups(config: RatersConfig, world: World) -> tuple[RaterGroup, ...]:
    """Resolve the rater groups.

    Raises:
        ValueError: If a group cannot be resolved, or regret labels are asked of an environment
            without a transition table.
    """
    response = Response(
        rationality=config.response.rationality,
        mistake=config.response.mistake,
        myopia=config.response.myopia,
        tie=config.response.tie,
        skip=config.response.skip,
    )
    label = cast("Any", config.label)
    return make_groups(list(config.groups), label=label, table=world.table, response=response)


@dataclass(frozen=True)
class Data:
    """What the raters saw and said.

    Attributes:
        segments: Replay buffer of N segments, one item each.
        preferences: TensorDict ``[M]``, see :mod:`popl_rl.keys`.
        worth: Worth of each segment to each group, ``[G, N]``; for evaluation only.
    """

    segments: TensorDictReplayBuffer
    preferences: TensorDict
    worth: Tensor

    @property
    def steps(self) -> TensorDictBase:
        """The segments as a TensorDict ``[N, T]``."""
        return stored_segments(self.segments)

    def save(self, path: Path) -> None:
        """Write segments and preferences below ``path``, replacing nothing."""
        for name, data in (("segments", self.steps), ("preferences", self.preferences)):
            if not (path / name).exists():
                save_tensordict(data, path / name)


def make_data(
    config: DataConfig,
    raters: RatersConfig,
    world: World,
    groups: tuple[RaterGroup, ...],
    *,
    seed: int,
    max_steps: int,
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
        max_steps: Steps after which an episode is cut.
        load: Folder to load from instead.
        progress: Called with the number of segments collected so far.

    Raises:
        ValueError: If there is less data than was asked for, or it does not fit the environment.
    """
    if load is None:
        segments = collect_segments(
            world.make_for_data,
            world.behaviours,
            num_segments=config.segments,
            length=config.length,
            generator=stream(seed, "segments"),
            shares=world.shares,
            max_steps=max_steps,
            progress=progress,
        )
    else:
        segments = load_tensordict(load / "segments", required={OBSERVATION: 3, ACTION: 2, INFO: 0})
        if len(segments) < config.segments:
            raise ValueError(
                f"data.segments asks for {config.segments} segments, but {load} holds "
                f"{len(segments)}; ask for fewer or collect more"
            )
        expected = world.env.observation_space.shape
        if segments[OBSERVATION].shape[2:] != expected:
            raise ValueError(
                f"{load} holds observations of shape {tuple(segments[OBSERVATION].shape[2:])}, but "
                f"the environment gives {expected}; it was collected in another environment"
            )
        segments.auto_batch_size_(2)
    memmap = None if config.memmap is None else Path(config.memmap)
    buffer = segment_buffer(segments, memmap=memmap)
    worth = torch.stack([group.worth(segments) for group in groups])
    if load is None:
        generator = stream(seed, "raters")
        people = Raters.draw(
            groups, num_raters=raters.count, shares=raters.shares, generator=generator
        )
        preferences = collect_preferences(
            buffer, people, answers_per_rater=raters.answers, generator=generator
        )[:].exclude("index")
    else:
        preferences = load_preferences(load / "preferences", num_segments=len(segments))
        group = preferences.get(GROUP, None)
        if group is not None and int(group.max()) >= len(groups):
            raise ValueError(
                f"{load} holds preferences of {int(group.max()) + 1} groups, but raters.groups "
                f"names {len(groups)}; name the groups that were asked then"
            )
    return Data(buffer, preferences, worth)


def build_popl(
    config: MethodConfig,
    spec: PolicySpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    generator: torch.Generator,
) -> POPL | TeamPOPL:
    """Build the trainer's inner loop; a warmed-up population, nothing selected yet.

    ``variation: auto`` means gradient variation for rater cases and teams for preference cases.
    """
    if variation_of(config) == "teams":
        settings = TeamSettings(
            teams=config.teams,
            generations=config.team_generations,
            alpha=config.alpha,
            conservatism=config.conservatism,
            discount=config.discount,
            learning_rate=config.learning_rate,
        )
        return TeamPOPL(spec, bank, comparisons, settings=settings, generator=generator)
    population = Population.create(
        spec, config.members, evolve=cast("Any", config.evolve), generator=generator
    ).to(bank.row.device)
    if variation_of(config) == "gaussian":
        variation: GaussianHead | GradientCPL = GaussianHead(
            population, std=config.mutation_std, generator=generator
        )
    else:
        loss = CPLLoss(
            population,
            bank,
            alpha=config.alpha,
            conservatism=config.conservatism,
            discount=config.discount,
        )
        variation = GradientCPL(
            loss,
            comparisons,
            generations=config.generations,
            learning_rate=config.learning_rate,
            steps=config.steps,
            batch_size=config.batch_size,
            generator=generator,
        )
        variation.warm_up(config.warm_up)
    return POPL(
        population,
        bank,
        comparisons,
        variation=variation,
        alpha=config.alpha,
        discount=config.discount,
        epsilon=cast("Any", parse_epsilon(config.epsilon)),
        generator=generator,
    )


def variation_of(config: MethodConfig) -> str:
    """The kind of variation that ``auto`` stands for, or the one that was asked for."""
    if config.variation != "auto":
        return config.variation
    return "gradient" if config.cases == "rater" else "teams"


def generations_of(config: MethodConfig) -> int:
    """Generations that a run of this method takes; those of teams are longer and fewer."""
    return config.team_generations if variation_of(config) == "teams" else config.generations


def final_policies(popl: POPL | TeamPOPL) -> PolicySet:
    """The policy set that a finished run has found."""
    if isinstance(popl, TeamPOPL):
        return popl.policies()
    return PolicySet.distinct(
        popl.population, popl.bank, popl.comparisons, alpha=popl.alpha, discount=popl.discount
    )
