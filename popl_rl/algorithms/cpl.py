"""What POPL is compared with: pooled CPL, and CPL that knows the groups (the oracle)."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from popl_rl.algorithms.draws import Draws, by_comparison
from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.problem import Method, Problem
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population

__all__ = ["GroupCPL", "group_weights", "pooled_population", "train"]

_BLOCKS = 30  # generations of a training that nobody looks at in between


def group_weights(group: Tensor, num_groups: int) -> Tensor:
    """Weights of a pooled policy and of one oracle per group, ``[1 + G, M]``.

    The oracle reads hidden labels: it is the ceiling for methods that do not.

    Args:
        group: Hidden group of each comparison, ``[M]``.
        num_groups: Number of groups G.

    Raises:
        ValueError: If some group made no comparison.
    """
    oracle = torch.nn.functional.one_hot(group, num_groups).T.float()
    silent = (oracle.sum(1) == 0).nonzero().squeeze(-1).tolist()
    if silent:
        raise ValueError(
            f"groups {silent} have no strict answer, so no oracle can be trained for them; draw "
            "more raters or give those groups a larger share"
        )
    return torch.cat([torch.ones(1, len(group)), oracle])


class GroupCPL(MultiCPL):
    """CPL hypotheses that draw each comparison as often as they are told to.

    With the weights of ``group_weights`` these are pooled CPL and the oracle of each group, by the
    recipe of every other method.

    Args:
        problem: What is to be learnt.
        weight: How often each of K hypotheses draws each comparison, ``[K, M]``.
        generator: Source of initial weights and batches.
    """

    def __init__(self, problem: Problem, *, weight: Tensor, generator: torch.Generator) -> None:
        population = problem.typical_population(len(weight), generator=generator)
        super().__init__(problem, population=population, generator=generator)
        self.draws = by_comparison(problem.comparisons, weight.to(problem.device))

    def _draws(self, scores: Callable[[], Tensor]) -> tuple[Draws, dict[str, float]]:  # noqa: ARG002
        return self.draws, {}

    def result(self) -> HypothesisSet:
        """The K hypotheses, in the order of the weights."""
        return self.problem.hypothesis_set(self.population)


def train(method: Method, *, progress: Callable[[int], None] | None = None) -> HypothesisSet:
    """Run a method to its end.

    Args:
        method: What to run, from wherever it is.
        progress: Called with the number of generations done.
    """
    step = method.step_unwatched if isinstance(method, MultiCPL) else method.step
    while method.generation < method.generations:
        step()
        if progress is not None:
            progress(method.generation)
    return method.result()


def pooled_population(problem: Problem, *, steps: int, generator: torch.Generator) -> Population:
    """One hypothesis trained on everybody's answers, from which others may start.

    Args:
        problem: What is to be learnt.
        steps: Gradient steps, in the place of the recipe's.
        generator: Source of initial weights and batches.
    """
    short = replace(
        problem,
        training=replace(problem.training, steps=steps),
        generations=min(_BLOCKS, steps),
    )
    population = problem.typical_population(1, generator=generator)
    method = MultiCPL(short, population=population, generator=generator)
    train(method)
    return method.population
