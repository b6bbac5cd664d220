"""From a configuration to the objects of a run. Configuration objects go no further than here."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium
import torch
from tensordict import TensorDictBase

from popl_rl.algorithms.alternatives import build_alternative
from popl_rl.algorithms.cpl import group_weights, train_cpl
from popl_rl.algorithms.em import EM
from popl_rl.algorithms.initialisation import conservatism_of, cpl_training, initial_population
from popl_rl.algorithms.mixture_population import MixturePOPL, MixtureSettings
from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.popl import POPL
from popl_rl.algorithms.rater_similarity import seed_with_specialists
from popl_rl.algorithms.refinement import RefinementSettings, refine
from popl_rl.algorithms.variation import GaussianHead, GradientCPL
from popl_rl.algorithms.vpl import VPL
from popl_rl.config import EvaluationConfig, MethodConfig, parse_epsilon
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import is_stateless
from popl_rl.experiments.data import Data, build_groups, fresh_segments, make_data
from popl_rl.keys import ANSWER, GROUP, Answer
from popl_rl.models.calibration import fit_scale
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec, reward_bank
from popl_rl.models.scoring import margins
from popl_rl.models.sets import as_set, load_set
from popl_rl.models.style_codes import StyleClone, load_clone, save_clone, train_clone
from popl_rl.models.style_population import StyledPopulation
from popl_rl.randomness import stream
from popl_rl.selection.rules import selection_of
from popl_rl.storage import locked

__all__ = [
    "Data",
    "Learner",
    "build_bank",
    "build_clone",
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
    "typical",
    "variation_of",
]

Learner = POPL | MixturePOPL | MultiCPL | EM | VPL
"""What trains generation by generation, and has a population after each."""


def build_spec(config: MethodConfig, env: gymnasium.Env[Any, Any]) -> PolicySpec | RewardSpec:
    """Sizes of the hypotheses: policies, or reward functions.

    Raises:
        ValueError: If policies are asked for where there is nothing to do.
    """
    if config.learns == "policy" and is_stateless(env):
        raise ValueError(
            "method.learns must be reward in an environment with a single action, got 'policy'"
        )
    if config.learns == "reward" or is_stateless(env):
        return RewardSpec.from_env(env, hidden=config.hidden)
    return PolicySpec.from_env(env, hidden=config.hidden)


def build_bank(segments: TensorDictBase, spec: PolicySpec | RewardSpec) -> SegmentBank:
    """Segments as these hypotheses read them."""
    if isinstance(spec, RewardSpec):
        return reward_bank(segments)
    return SegmentBank.from_segments(segments)


def build_clone(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    *,
    seed: int,
    path: Path,
    progress: Callable[[int], None] | None = None,
) -> StyleClone:
    """Train the style clone of a run, or load it if a run on the same segments has trained it.

    Args:
        config: Length of the codes, and how to train.
        spec: Sizes of the policies.
        bank: Segments.
        seed: Seed of the run.
        path: Folder to keep it in, one for each seed and configuration.
        progress: Called with the number of steps done.

    Raises:
        ValueError: If hypotheses are no policies, or the folder is damaged.
    """
    if not isinstance(spec, PolicySpec):
        raise ValueError("a style clone acts, so method.learns must be policy, got reward")
    settings = (config.code_dim, config.clone_steps, config.clone_beta, *spec.hidden)
    path = path / "-".join(map(str, (f"clone-seed{seed}", *settings)))
    with locked(path):
        if path.is_dir():
            return load_clone(spec, path).to(bank.row.device)
        clone = train_clone(
            spec,
            bank,
            code_dim=config.code_dim,
            steps=config.clone_steps,
            beta=config.clone_beta,
            generator=stream(seed, "clone", bank.row.device),
            progress=progress,
        )
        save_clone(clone, path)
    return clone


def build_popl(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    clone: StyleClone | None = None,
    generator: torch.Generator,
) -> Learner:
    """Build the trainer's inner loop; a warmed-up population, nothing selected yet.

    ``variation: auto`` means gradient variation for rater cases and teams for preference cases.
    Members are style codes if ``clone`` is given.

    Raises:
        ValueError: If settings do not go together, or a package that they need is missing.
    """
    if config.algorithm != "popl":
        return build_alternative(config, spec, bank, comparisons, clone=clone, generator=generator)
    select = selection_of(config.selection, tournament=config.tournament)
    if variation_of(config) == "teams":
        settings = MixtureSettings(
            teams=config.teams,
            generations=config.team_generations,
            alpha=config.alpha,
            conservatism=conservatism_of(config, spec),
            discount=config.discount,
            learning_rate=config.learning_rate,
            polish_alpha=config.polish_alpha,
            polish_conservatism=(
                config.polish_conservatism if isinstance(spec, PolicySpec) else 1.0
            ),
        )
        return MixturePOPL(
            spec, bank, comparisons, settings=settings, select=select, generator=generator
        )
    if config.evolve == "head" and config.features == "pooled":
        networks = [build_network(spec, generator=generator) for _ in range(config.members)]
        pooled = _pooled(config, spec, bank, comparisons, generator=generator)
        networks[0] = pooled.network(0).cpu()
        population = Population(networks, spec, evolve="head").to(bank.row.device)
    else:
        population = initial_population(
            config,
            spec,
            config.members,
            clone=clone,
            device=bank.row.device,
            generator=generator,
        )
    similarity: torch.Tensor | None = None
    if variation_of(config) == "gaussian":
        variation: GaussianHead | GradientCPL = GaussianHead(
            population, std=config.mutation_std, generator=generator
        )
    else:
        variation = cpl_training(config, population, bank, comparisons, generator=generator)
        if config.kinship and config.cases == "rater":
            if config.evolve == "head":
                single = population.subset([0])
            else:
                single = _pooled(config, spec, bank, comparisons, clone=clone, generator=generator)
            similarity = seed_with_specialists(
                population,
                single,
                variation.loss,
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
        similarity=similarity,
        select=select,
        refinement=_polish_settings(config, spec),
        generator=generator,
    )


def _polish_settings(
    config: MethodConfig, spec: PolicySpec | RewardSpec
) -> RefinementSettings | None:
    """None where it has not been tried: reward functions, heads, no rater ids."""
    tried = config.evolve in ("all", "code") and isinstance(spec, PolicySpec)
    asked = variation_of(config) == "gradient" and config.cases == "rater"
    if not (tried and asked and config.polish_steps):
        return None
    return RefinementSettings(
        steps=config.polish_steps,
        # 30 looks at who serves whom.
        block=max(1, config.polish_steps // 30),
        # A batch is shared by all members, so it is larger than those of children.
        batch_size=256 if config.evolve == "all" else 4 * config.batch_size,
        learning_rate=config.learning_rate,
        alpha=config.polish_alpha,
        conservatism=config.polish_conservatism,
        discount=config.discount,
    )


def _pooled(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    clone: StyleClone | None = None,
    generator: torch.Generator,
) -> Population:
    """One member trained on everybody's answers, from which others may start."""
    # A step on style codes of long segments costs a hundred times what it costs elsewhere.
    batch_size = 256 if clone is None else config.batch_size
    return train_cpl(
        spec,
        bank,
        comparisons,
        torch.ones(1, len(comparisons), device=bank.row.device),
        steps=config.pooled_steps,
        batch_size=batch_size,
        learning_rate=config.learning_rate,
        alpha=config.alpha,
        conservatism=conservatism_of(config, spec),
        discount=config.discount,
        population=None if clone is None else typical(clone),
        generator=generator,
    ).population


def typical(clone: StyleClone, count: int = 1) -> Population:
    """Copies of the data's typical style: what one can do without asking anybody."""
    return StyledPopulation(clone, clone.typical().expand(count, -1))


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
    return config.name


def final_set(popl: Learner) -> HypothesisSet:
    """The policies, or reward functions, that a finished run has found."""
    if isinstance(popl, MixturePOPL | VPL):
        return popl.policies()
    if isinstance(popl, EM):
        found = popl.policies()
    elif isinstance(popl, POPL) and popl.refinement is not None:
        refined = refine(
            popl.population,
            popl.bank,
            popl.comparisons,
            alpha=popl.alpha,
            settings=popl.refinement,
            generator=popl.generator,
        )
        found = as_set(refined, alpha=popl.refinement.alpha, discount=popl.discount)
        found.origin = []  # trained on, they are no longer members of the population
    else:
        everybody = as_set(popl.population, alpha=popl.alpha, discount=popl.discount)
        found = everybody.distinct(popl.bank, popl.comparisons)
    if isinstance(found, PolicySet):
        margin = margins(
            found.population,
            popl.bank,
            popl.comparisons,
            alpha=found.alpha,
            discount=found.discount,
        )
        found.alpha *= fit_scale(margin, popl.comparisons)
    return found


def train_baselines(
    config: EvaluationConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    preferences: TensorDictBase,
    *,
    num_groups: int,
    clone: StyleClone | None = None,
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
        clone: What hypotheses are style codes of; they are whole networks if None.
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
        population=None if clone is None else typical(clone, len(weight)),
        generator=generator,
        progress=progress,
    )
