"""From a configuration to the objects of a run. Configuration objects go no further than here."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from popl_rl.alternatives import build_alternative
from popl_rl.baselines import group_weights, train_cpl
from popl_rl.comparisons import Comparisons
from popl_rl.config import (
    ALGORITHMS,
    DataConfig,
    EvaluationConfig,
    MethodConfig,
    RatersConfig,
    parse_epsilon,
)
from popl_rl.em import EM
from popl_rl.keys import ACTION, ANSWER, GROUP, INFO, OBSERVATION, Answer
from popl_rl.kinship import seed_with_specialists
from popl_rl.losses import CPLLoss
from popl_rl.multi_cpl import MultiCPL
from popl_rl.policies import PolicySpec, build_network
from popl_rl.policy_set import HypothesisSet, as_set, load_set
from popl_rl.popl import POPL
from popl_rl.population import Population
from popl_rl.preferences import collect_preferences, load_preferences
from popl_rl.raters import RaterGroup, Raters, Response, make_groups
from popl_rl.rewards import RewardSpec, reward_bank
from popl_rl.segments import (
    SegmentBank,
    collect_segments,
    load_tensordict,
    save_tensordict,
    segment_buffer,
    stored_segments,
)
from popl_rl.selection import selection_of
from popl_rl.teams import TeamPOPL, TeamSettings
from popl_rl.variation import GaussianHead, GradientCPL
from popl_rl.vpl import VPL
from popl_rl.worlds import World, has_nothing_to_do

__all__ = [
    "Data",
    "Learner",
    "build_bank",
    "build_groups",
    "build_popl",
    "build_spec",
    "final_set",
    "fresh_segments",
    "generations_of",
    "label_of",
    "make_data",
    "stream",
    "train_baselines",
    "variation_of",
]

Learner = POPL | TeamPOPL | MultiCPL | EM | VPL
"""What trains generation by generation, and has a population after each."""


def stream(seed: int, name: str, device: torch.device | str = "cpu") -> torch.Generator:
    """An independent source of randomness for one purpose of a run.

    Each purpose has its own, so that asking for more of one thing changes nothing else.
    """
    return torch.Generator(device).manual_seed(zlib.crc32(f"{seed}/{name}".encode()))


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


def fresh_segments(config: DataConfig, world: World, *, seed: int, max_steps: int) -> TensorDict:
    """As many segments as were collected for training, that nobody has seen."""
    return collect_segments(
        world.make_for_data,
        world.behaviours,
        num_segments=config.segments,
        length=config.length,
        generator=stream(seed, "fresh segments"),
        shares=world.shares,
        max_steps=max_steps,
    )


def build_spec(config: MethodConfig, env: gymnasium.Env[Any, Any]) -> PolicySpec | RewardSpec:
    """Sizes of the hypotheses: policies, or reward functions.

    Raises:
        ValueError: If policies are asked for where there is nothing to do.
    """
    if config.learns == "policy" and has_nothing_to_do(env):
        raise ValueError(
            "method.learns must be reward in an environment with a single action, got 'policy'"
        )
    if config.learns == "reward" or has_nothing_to_do(env):
        return RewardSpec.from_env(env, hidden=config.hidden)
    return PolicySpec.from_env(env, hidden=config.hidden)


def build_bank(segments: TensorDictBase, spec: PolicySpec | RewardSpec) -> SegmentBank:
    """Segments as these hypotheses read them."""
    if isinstance(spec, RewardSpec):
        return reward_bank(segments)
    return SegmentBank.from_segments(segments)


def build_popl(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    generator: torch.Generator,
) -> Learner:
    """Build the trainer's inner loop; a warmed-up population, nothing selected yet.

    ``variation: auto`` means gradient variation for rater cases and teams for preference cases.

    Raises:
        ValueError: If settings do not go together, or a package that they need is missing.
    """
    # Conservatism keeps policies near the data; of reward functions only differences matter.
    conservatism = config.conservatism if isinstance(spec, PolicySpec) else 1.0
    if config.algorithm != "popl":
        return build_alternative(config, spec, bank, comparisons, generator=generator)
    select = selection_of(config.selection, tournament=config.tournament)
    if variation_of(config) == "teams":
        settings = TeamSettings(
            teams=config.teams,
            generations=config.team_generations,
            alpha=config.alpha,
            conservatism=conservatism,
            discount=config.discount,
            learning_rate=config.learning_rate,
        )
        return TeamPOPL(
            spec, bank, comparisons, settings=settings, select=select, generator=generator
        )
    networks = [build_network(spec, generator=generator) for _ in range(config.members)]
    if config.evolve == "head" and config.features == "pooled":
        networks[0] = _pooled_network(config, spec, bank, comparisons, generator=generator)
    population = Population(networks, spec, evolve=cast("Any", config.evolve))
    population = population.to(bank.row.device)
    kin: torch.Tensor | None = None
    if variation_of(config) == "gaussian":
        variation: GaussianHead | GradientCPL = GaussianHead(
            population, std=config.mutation_std, generator=generator
        )
    else:
        loss = CPLLoss(
            population,
            bank,
            alpha=config.alpha,
            conservatism=conservatism,
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
        if config.kinship and config.cases == "rater":
            pooled = networks[0]
            if config.evolve == "all":
                pooled = _pooled_network(config, spec, bank, comparisons, generator=generator)
            kin = seed_with_specialists(
                population,
                pooled,
                loss,
                comparisons,
                steps=config.specialist_steps,
                learning_rate=config.learning_rate / 2,
                generator=generator,
            )
        else:
            variation.warm_up(config.warm_up)
    return POPL(
        population,
        bank,
        comparisons,
        variation=variation,
        alpha=config.alpha,
        discount=config.discount,
        epsilon=cast("Any", parse_epsilon(config.epsilon)),
        kin=kin,
        select=select,
        generator=generator,
    )


def _pooled_network(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    generator: torch.Generator,
) -> torch.nn.Sequential:
    """A network trained on everybody's answers, whose trunk is worth sharing."""
    pooled = train_cpl(
        spec,
        bank,
        comparisons,
        torch.ones(1, len(comparisons), device=bank.row.device),
        steps=config.pooled_steps,
        learning_rate=config.learning_rate,
        alpha=config.alpha,
        conservatism=config.conservatism if isinstance(spec, PolicySpec) else 1.0,
        discount=config.discount,
        generator=generator,
    )
    return pooled.population.network(0).cpu()


def variation_of(config: MethodConfig) -> str:
    """The kind of variation that ``auto`` stands for, or the one that was asked for."""
    if config.variation != "auto":
        return config.variation
    return "gradient" if config.cases == "rater" else "teams"


def generations_of(config: MethodConfig) -> int:
    """Generations that a run of this method takes; those of teams are longer and fewer."""
    teams = config.algorithm == "popl" and variation_of(config) == "teams"
    return config.team_generations if teams else config.generations


def label_of(config: MethodConfig) -> str:
    """What the rows of this method are called in ``results.csv``."""
    return ALGORITHMS[config.algorithm]


def final_set(popl: Learner) -> HypothesisSet:
    """The policies, or reward functions, that a finished run has found."""
    if isinstance(popl, TeamPOPL | EM | VPL):
        return popl.policies()
    everybody = as_set(popl.population, alpha=popl.alpha, discount=popl.discount)
    return everybody.distinct(popl.bank, popl.comparisons)


def train_baselines(
    config: EvaluationConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    preferences: TensorDictBase,
    *,
    num_groups: int,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
) -> HypothesisSet:
    """Train one hypothesis on everybody's answers and an oracle for each group, or load them.

    Args:
        config: How to train, or what to load.
        spec: Sizes of the hypotheses.
        bank: Segments.
        comparisons: The strict ones among ``preferences``.
        preferences: With the hidden groups, which oracles are told.
        num_groups: Number of groups G.
        generator: Source of initial weights and batches.
        progress: Called with the number of steps done.

    Returns:
        ``1 + G`` hypotheses.

    Raises:
        ValueError: If the groups are unknown, some group has no strict answer, or what is loaded
            does not fit.
    """
    if config.baselines_from is not None:
        loaded = load_set(config.baselines_from)
        own = loaded.population.spec
        # Other hidden layers do: baselines need not be built as the members are.
        kinds = [(type(s), s.observation_dim, s.action_dim, s.discrete) for s in (own, spec)]
        if len(loaded) != 1 + num_groups or kinds[0] != kinds[1]:
            raise ValueError(
                f"evaluation.baselines_from: {config.baselines_from} holds {len(loaded)} of "
                f"{own}, expected {1 + num_groups} of {spec}; name a run on the same data"
            )
        loaded.population.to(bank.row.device)
        return loaded
    if GROUP not in preferences.keys(True):
        raise ValueError(
            "the loaded preferences name no hidden groups, which the oracle needs; set "
            "evaluation.baselines=false"
        )
    strict = preferences[ANSWER] <= Answer.SECOND
    weight = group_weights(preferences[GROUP][strict], num_groups)
    return train_cpl(
        spec,
        bank,
        comparisons,
        weight.to(bank.row.device),
        steps=config.baseline_steps,
        batch_size=config.baseline_batch_size,
        learning_rate=config.baseline_learning_rate,
        alpha=config.baseline_alpha,
        conservatism=config.baseline_conservatism if isinstance(spec, PolicySpec) else 1.0,
        generator=generator,
        progress=progress,
    )
