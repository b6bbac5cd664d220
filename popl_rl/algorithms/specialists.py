"""A specialist for a rater: a copy of a common ancestor, trained for a moment on what one said."""

from dataclasses import dataclass

import torch
from torch import Tensor

from popl_rl.algorithms.cpl import pooled_population
from popl_rl.algorithms.draws import by_case
from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.algorithms.problem import Problem
from popl_rl.config import POPLSettings
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.optim import adam

__all__ = ["Specialists", "personalise", "specialists", "train_specialists"]


@dataclass(frozen=True)
class Specialists:
    """Specialists for some raters, and how well each ranks what the others said.

    Attributes:
        population: S members.
        values: Share of each rater's answers that a specialist ranks as the rater did, ``[S, C]``.
            Of its own rater a specialist says nothing: in its place is its mean over the others.
    """

    population: Population
    values: Tensor


def specialists(
    single: Population,
    loss: CPLLoss,
    comparisons: Comparisons,
    raters: Tensor,
    *,
    steps: int = 20,
    learning_rate: float = 1e-2,
    batch_size: int = 16,
    generator: torch.Generator,
) -> Population:
    """Copies of one member, each trained for a moment on the answers of one rater.

    Args:
        single: A population of one, trained on everybody's answers.
        loss: The loss to descend; its population is not used.
        comparisons: M strict preferences of C raters.
        raters: S of them, by their cases.
        steps: Gradient steps of each copy.
        learning_rate: Adam's step size.
        batch_size: Answers per step.
        generator: Source of the batches.

    Returns:
        S members, in the order of ``raters``.
    """
    copies = single.subset([0] * len(raters))
    own = CPLLoss(
        copies,
        loss.bank,
        alpha=loss.alpha,
        conservatism=loss.conservatism,
        discount=loss.discount,
        slip=loss.slip,
    )
    personalise(
        own,
        comparisons,
        raters,
        steps=steps,
        learning_rate=learning_rate,
        batch_size=batch_size,
        generator=generator,
    )
    return copies


def personalise(
    loss: CPLLoss,
    comparisons: Comparisons,
    raters: Tensor,
    *,
    steps: int,
    learning_rate: float,
    batch_size: int,
    generator: torch.Generator,
) -> None:
    """Train each member for a moment on the answers of one rater.

    There is no cloning: a few steps keep near where a member starts, while a prior that weighs as
    much as one rater's answers would hide what the rater wants.

    Args:
        loss: The loss to descend, whose S members are changed in place; without cloning.
        comparisons: M strict preferences of C raters.
        raters: The rater of each member, by their cases, ``[S]``.
        steps: Gradient steps.
        learning_rate: Adam's step size.
        batch_size: Answers per step.
        generator: Source of the batches.
    """
    own = comparisons.rows(torch.isin(comparisons.case, raters).nonzero()[:, 0])
    everybody = torch.arange(comparisons.num_cases, device=raters.device)
    descend(
        loss,
        adam(loss.population.members.parameters(), lr=learning_rate),
        own,
        steps=steps,
        batch_size=batch_size,
        draws=by_case(own, (everybody == raters.unsqueeze(1)).float(), least=0.0),
        generator=generator,
    )


def train_specialists(
    problem: Problem,
    popl: POPLSettings,
    *,
    most: int,
    generator: torch.Generator,
) -> Specialists:
    """Train a specialist for each of at most ``most`` random raters.

    Args:
        problem: What is to be learnt.
        popl: Steps of the common ancestor and of each specialist.
        most: Specialists, if there are as many raters.
        generator: Source of raters, initial weights and batches.
    """
    comparisons = problem.comparisons
    ancestor = pooled_population(problem, steps=popl.pooled_steps, generator=generator)
    asked = comparisons.case.unique()
    order = torch.randperm(len(asked), generator=generator, device=generator.device)
    rater = asked[order[:most]]
    found = specialists(
        ancestor,
        problem.loss(ancestor),
        comparisons,
        rater,
        steps=popl.specialist_steps,
        learning_rate=problem.training.learning_rate / 2,
        generator=generator,
    )
    values = problem.pass_shares(found).values
    place = torch.arange(len(rater), device=rater.device)
    own = values[place, rater]
    others = (values.sum(1) - own) / max(1, values.shape[1] - 1)
    return Specialists(found, values.index_put((place, rater), others))
