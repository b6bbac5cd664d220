"""From settings to what is learnt and by what: hypotheses, clone, problem, method, baselines."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.algorithms.cpl import GroupCPL, group_weights, train
from popl_rl.algorithms.plugged import checked_method
from popl_rl.algorithms.problem import Method, Problem
from popl_rl.config import EvaluationConfig, MethodConfig, plain
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import is_stateless
from popl_rl.keys import ANSWER, GROUP, Answer
from popl_rl.locks import locked
from popl_rl.manifest import digest_of_tensors
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec, Spec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.sets import load_set
from popl_rl.models.style_codes import StyleClone, load_clone, save_clone, train_clone
from popl_rl.plug_ins import defined, failure, is_foreign
from popl_rl.randomness import stream
from popl_rl.registry import resolve

__all__ = [
    "build_clone",
    "build_method",
    "build_problem",
    "build_spec",
    "check_answers",
    "check_baselines",
    "train_baselines",
]


#: Why a group has no strict answer, and what to do: without raters, and with raters.
_SILENT = (
    "nobody is of this group: ask more raters (raters.count), or give it a larger share",
    "its raters find both segments equally good in all of their {asked} answers, or skip: its "
    "function may read what is the same in all segments",
)


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
    return PolicySpec.from_env(env, hidden=config.hidden, channels=plain(config).convolutions())


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
    # Its network reads codes beside observations, which are no pixels then.
    spec = replace(spec, image=(), channels=())
    how = config.clone
    settings = (how.code_dim, how.steps, how.beta, *spec.hidden)
    path = path / "-".join(map(str, (f"clone-seed{seed}", *settings)))
    digest = digest_of_tensors(
        TensorDict({"observation": bank.observation, "row": bank.row, "action": bank.action})
    )[""]
    with locked(path):
        if path.is_dir():
            return load_clone(spec, path, bank=digest).to(bank.row.device)
        clone = train_clone(
            spec,
            bank,
            code_dim=how.code_dim,
            steps=how.steps,
            beta=how.beta,
            generator=stream(seed, "clone", bank.row.device),
            progress=progress,
        )
        save_clone(clone, path, bank=digest)
    return clone


def build_problem(
    config: MethodConfig,
    spec: PolicySpec | RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    clone: StyleClone | None = None,
) -> Problem:
    """What every method of a run is given.

    Args:
        config: The recipe, what members are, and how many.
        spec: Sizes of the hypotheses.
        bank: N segments.
        comparisons: M strict preferences.
        clone: What members are style codes of; used if ``method.evolve`` is ``"code"``.

    Raises:
        ValueError: If members are to be style codes and there is no clone.
    """
    config = plain(config)
    is_code = config.evolve == "code"
    if is_code and clone is None:
        raise ValueError("method.evolve=code needs a style clone; build one with build_clone()")
    return Problem(
        spec=spec,
        bank=bank,
        comparisons=comparisons,
        training=config.training,
        clone=clone if is_code else None,
        evolve="head" if config.evolve == "head" else "all",
        members=config.members,
        generations=config.generations,
    )


def build_method(
    config: MethodConfig, problem: Problem, *, num_groups: int, generator: torch.Generator
) -> Method:
    """Build what ``method.factory`` names from the problem and the sections that it reads.

    Args:
        config: Which method, and its settings.
        problem: What is to be learnt.
        num_groups: Number of rater groups, which methods that have to be told are told.
        generator: Source of all randomness.

    Raises:
        ValueError: If there is no such method, or settings do not go together.
        TypeError: If the factory does not take these arguments.
    """
    config = plain(config)
    factory = resolve("method", config.factory)
    sections = {
        name: getattr(config, name)
        for name in config.sections()
        if name not in ("training", "clone")
    }
    if "em" in sections and config.em.groups is None:
        sections["em"] = replace(config.em, groups=num_groups)
    if "kmeans" in sections and config.kmeans.groups is None and not config.kmeans.silhouette:
        sections["kmeans"] = replace(config.kmeans, groups=num_groups)
    try:
        method = factory(problem, generator=generator, **sections, **config.options)
    except TypeError as error:
        raise TypeError(
            f"method {config.name!r}: {config.factory} was called with problem, generator and "
            f"{sorted([*sections, *config.options])}, and failed: {error} ({defined(factory)})"
        ) from error
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) or not is_foreign(factory):
            raise
        raise failure("method", config.name, "building it", error, factory) from error
    return checked_method(method, config.name)


def train_baselines(
    config: EvaluationConfig,
    problem: Problem,
    preferences: TensorDictBase,
    *,
    num_groups: int,
    digests: Mapping[str, str] | None = None,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
) -> HypothesisSet:
    """Train one hypothesis on everybody's answers and an oracle for each group, or load them.

    Args:
        config: What to load, if anything.
        problem: What the method was given, with the recipe that these are trained by too.
        preferences: With the hidden groups, which oracles are told; the problem's comparisons are
            of these.
        num_groups: Number of groups G.
        digests: Of ``segments`` and ``preferences``: what is loaded must have been trained on them.
        generator: Source of initial weights and batches.
        progress: Called with the number of generations done.

    Returns:
        ``1 + G`` hypotheses.

    Raises:
        ValueError: If the groups are unknown, some group has no strict answer, or what is loaded
            does not fit.
    """
    if config.baselines_from is not None:
        return _load_baselines(config.baselines_from, problem, num_groups, digests or {})
    if GROUP not in preferences.keys(True):
        raise ValueError(
            "the loaded preferences name no hidden groups, which the oracle needs; set "
            "evaluation.baselines=false"
        )
    weight = group_weights(_groups_of(problem.comparisons, preferences), num_groups)
    return train(GroupCPL(problem, weight=weight, generator=generator), progress=progress)


def check_answers(
    config: EvaluationConfig,
    comparisons: Comparisons,
    preferences: TensorDictBase,
    names: Sequence[str],
) -> None:
    """Raise, before anything is trained, if a group's oracle would have nothing to learn from.

    Args:
        config: Whether there will be oracles.
        comparisons: What is learnt from, of the preferences.
        preferences: With the hidden groups; without them nothing is checked.
        names: What messages call the groups.

    Raises:
        ValueError: If a group has no strict answer.
    """
    if not config.baselines or config.baselines_from is not None:
        return
    if GROUP not in preferences.keys(True):
        return
    answers = preferences[GROUP].bincount(minlength=len(names)).tolist()
    strict = _groups_of(comparisons, preferences).bincount(minlength=len(names)).tolist()
    for name, asked, told in zip(names, answers, strict, strict=True):
        if told == 0:
            raise ValueError(
                f"raters.groups: {name!r} has no strict answer, so no oracle can be trained for "
                "it; " + _SILENT[asked > 0].format(asked=asked)
            )


def _groups_of(comparisons: Comparisons, preferences: TensorDictBase) -> Tensor:
    """Hidden group of who gave the answer that each comparison is of, ``[M]``."""
    has_halves = comparisons.answer is not None and comparisons.stage is None
    kept = preferences[ANSWER] <= (Answer.TIE if has_halves else Answer.SECOND)
    group: Tensor = preferences[GROUP][kept]
    if comparisons.answer is None or not has_halves:
        return group
    return group[comparisons.answer.to(group.device)]


def _load_baselines(
    path: str, problem: Problem, num_groups: int, digests: Mapping[str, str]
) -> HypothesisSet:
    loaded = load_set(path)
    check_baselines(loaded, path, problem.spec, num_groups)
    known = loaded.provenance
    others = [name for name in digests if known.get(name, digests[name]) != digests[name]]
    if others:
        raise ValueError(
            f"evaluation.baselines_from: {path} was trained on other {' and '.join(others)}; name "
            "a run on the same data"
        )
    loaded.population.to(problem.device)
    return loaded


def check_baselines(loaded: HypothesisSet, path: str, spec: Spec, num_groups: int) -> None:
    """Raise unless baselines of another run can be those of this one.

    Args:
        loaded: The baselines.
        path: Where they are from, for the message.
        spec: Sizes of the hypotheses.
        num_groups: Number of groups G.

    Raises:
        ValueError: If they are not ``1 + G``, or act or judge in another world.
    """
    own = loaded.population.spec
    # Other hidden layers do: baselines need not be built as the members are.
    kinds = [(type(s), s.observation_dim, s.action_dim, s.discrete) for s in (own, spec)]
    if len(loaded) != 1 + num_groups or kinds[0] != kinds[1]:
        raise ValueError(
            f"evaluation.baselines_from: {path} holds {len(loaded)} of {own}, expected "
            f"{1 + num_groups} of {spec}; name a run on the same data"
        )
