"""POPL from its settings: the population it starts from, selection, variation, refinement."""

from typing import Any, cast

import torch

from popl_rl.algorithms.cpl import pooled_population
from popl_rl.algorithms.mixture_population import MixturePOPL
from popl_rl.algorithms.plugged import checked_selection
from popl_rl.algorithms.popl import POPL
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.rater_similarity import seed_with_specialists
from popl_rl.algorithms.variation import GaussianHead, GradientCPL
from popl_rl.config import MixtureSettings, POPLSettings, RefinementSettings, parse_epsilon
from popl_rl.models.policies import build_network
from popl_rl.models.population import Population
from popl_rl.registry import resolve
from popl_rl.selection.rules import SELECTIONS, Selection, selection_rule

__all__ = ["build_popl", "kind_of_variation"]


def kind_of_variation(settings: POPLSettings, problem: Problem) -> str:
    """The kind that ``auto`` stands for: gradient with rater ids, mixtures without."""
    if settings.variation != "auto":
        return settings.variation
    return "mixtures" if problem.comparisons.is_single else "gradient"


def find_rule(reference: str, *, tournament: int) -> Selection | None:
    """A rule of selection by its name here, or by a reference of kind ``selection``.

    Args:
        reference: ``"lexicase"``, which None stands for, or another rule.
        tournament: Members in a tournament.

    Raises:
        ValueError: If there is no such rule, or a package that it needs is missing.
    """
    if reference == "lexicase" or reference in SELECTIONS:
        return selection_rule(reference, tournament=tournament)
    return checked_selection(resolve("selection", reference), reference)


def build_popl(
    problem: Problem,
    *,
    popl: POPLSettings | None = None,
    refinement: RefinementSettings | None = None,
    mixture: MixtureSettings | None = None,
    generator: torch.Generator,
) -> POPL | MixturePOPL:
    """Build POPL: a population to start from, nothing selected yet.

    Args:
        problem: What is to be learnt.
        popl: Selection and variation.
        refinement: The last training.
        mixture: POPL without rater ids.
        generator: Source of all randomness.

    Raises:
        ValueError: If settings do not go together, or a package that they need is missing.
    """
    popl = popl or POPLSettings()
    refinement = refinement or RefinementSettings()
    select = find_rule(popl.selection, tournament=popl.tournament)
    kind = kind_of_variation(popl, problem)
    if kind == "mixtures":
        return MixturePOPL(
            problem, settings=mixture or MixtureSettings(), select=select, generator=generator
        )
    options: dict[str, Any] = {
        "epsilon": cast("Any", parse_epsilon(popl.epsilon)),
        "select": select,
        "generator": generator,
    }
    if kind == "gaussian":
        population = _first_heads(problem, popl, generator)
        variation = GaussianHead(population, std=popl.mutation_std, generator=generator)
        return POPL(problem, population=population, variation=variation, **options)
    return _gradient(problem, popl, refinement, options)


def _gradient(
    problem: Problem,
    popl: POPLSettings,
    refinement: RefinementSettings,
    options: dict[str, Any],
) -> POPL:
    generator = options["generator"]
    population = _first_heads(problem, popl, generator)
    variation = GradientCPL.of(problem, population, generator=generator)
    if not popl.rater_similarity or problem.comparisons.is_single:
        variation.warm_up(popl.warm_up)
        return POPL(problem, population=population, variation=variation, **options)
    if problem.evolve == "head":
        single = population.subset([0])
    else:
        single = pooled_population(problem, steps=popl.pooled_steps, generator=generator)
    similarity = seed_with_specialists(
        population,
        single,
        variation.loss,
        problem.comparisons,
        steps=popl.specialist_steps,
        learning_rate=problem.training.learning_rate / 2,
        generator=generator,
    )
    # It has not been tried for heads, and for reward functions with real people alone.
    tried = problem.evolve == "all" and (problem.spec.refines or refinement.rewards)
    return POPL(
        problem,
        population=population,
        variation=variation,
        similarity=similarity,
        refinement=refinement if tried and refinement.steps else None,
        **options,
    )


def _first_heads(problem: Problem, popl: POPLSettings, generator: torch.Generator) -> Population:
    """Fresh members; heads may share the trunk of a network trained on everybody's answers."""
    if problem.evolve != "head" or popl.features == "random":
        return problem.initial_population(problem.members, generator=generator)
    networks = [build_network(problem.spec, generator=generator) for _ in range(problem.members)]
    pooled = pooled_population(problem, steps=popl.pooled_steps, generator=generator)
    networks[0] = pooled.network(0).cpu()
    return Population(networks, problem.spec, evolve="head").to(problem.device)
