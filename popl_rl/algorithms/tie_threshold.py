"""How wide the range of differences is in which raters call two segments equal."""

from dataclasses import replace

import torch

from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.problem import Problem
from popl_rl.models.preference_likelihood import fit_threshold

__all__ = ["with_threshold"]

_BLOCKS = 10  # fits of the threshold, one after each block of gradient steps


def with_threshold(
    problem: Problem, *, threshold: float | None = None, generator: torch.Generator
) -> Problem:
    """The same problem with the threshold of its model of draws (Rao and Kupper, 1967).

    It is fitted to one hypothesis that learns from everybody by the recipe, in turns with it. Where
    groups disagree, that hypothesis has smaller margins than the members of a set will have, and
    the threshold is too small rather than too large.

    Args:
        problem: What is to be learnt; without ties it is returned as it is.
        threshold: The threshold, in units of margins; fitted if None.
        generator: Source of initial weights and batches.
    """
    if problem.comparisons.tied is None:
        return problem
    if threshold is not None:
        return _with(problem, threshold)
    short = replace(problem, generations=_BLOCKS)
    population = problem.typical_population(1, generator=generator)
    pooled = MultiCPL(short, population=population, generator=generator)
    while pooled.generation < pooled.generations:
        pooled.step_unwatched()
        scores = pooled.problem.compared_scores(population)[0]
        said = problem.comparisons
        margin = scores[said.preferred] - pooled.problem.conservatism * scores[said.other]
        pooled.problem = _with(short, fit_threshold(margin, said, problem.training.slip))
        pooled.training.comparisons = pooled.problem.comparisons
    return _with(problem, pooled.problem.comparisons.threshold)


def _with(problem: Problem, threshold: float) -> Problem:
    return replace(problem, comparisons=replace(problem.comparisons, threshold=threshold))
