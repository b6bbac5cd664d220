"""Which raters want alike, told by a specialist for every rater."""

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.models.scoring import case_values, margins
from popl_rl.selection.lexicase import lexicase_selection
from popl_rl.selection.mad import mad

__all__ = ["rater_similarity", "seed_with_specialists", "specialists"]

_MOST = 256  # specialists; more tell no more, but cost time and memory


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
    descend(
        own,
        torch.optim.Adam(copies.members.parameters(), lr=learning_rate),
        comparisons,
        steps=steps,
        batch_size=batch_size,
        weight=(comparisons.case == raters.unsqueeze(1)).float(),
        generator=generator,
    )
    return copies


def rater_similarity(margin: Tensor, comparisons: Comparisons, raters: Tensor) -> Tensor:
    """How alike raters want, from how well specialists for some of them explain each.

    Raters of one group are explained well by the same specialists. So the log-likelihoods of a
    rater's answers under all specialists are a profile, and two raters are as close as their
    profiles are correlated. The specialist for a rater says nothing about itself.

    Args:
        margin: Margins of the S specialists on M comparisons, ``[S, M]``.
        comparisons: Whose cases are the C raters.
        raters: Whom the specialists are for, ``[S]``.

    Returns:
        Correlations in [-1, 1], ``[C, C]``; 0 for a rater whom all specialists explain alike.
    """
    likelihood = case_values(F.logsigmoid(margin), comparisons)
    place = torch.arange(len(raters), device=raters.device)
    own = likelihood[place, raters]
    # In its own place, what the others have on average.
    others = (likelihood.sum(0)[raters] - own) / max(1, len(raters) - 1)
    profile = likelihood.index_put((place, raters), others)
    profile = profile - profile.mean(0)
    profile = profile / profile.norm(dim=0).clamp(min=1e-9)
    alike: Tensor = profile.T @ profile
    return alike


def seed_with_specialists(
    population: Population,
    single: Population,
    loss: CPLLoss,
    comparisons: Comparisons,
    *,
    steps: int = 20,
    learning_rate: float = 1e-2,
    generator: torch.Generator,
) -> Tensor:
    """Replace a population by selected specialists, and tell how alike raters want.

    Args:
        population: N members, overwritten.
        single: A population of one, trained on everybody's answers, of which specialists are
            copies; with the population's trunk, if it has one.
        loss: The loss of that population.
        comparisons: M strict preferences of C raters.
        steps: Gradient steps of each specialist.
        learning_rate: Adam's step size for them.
        generator: Source of randomness.

    Returns:
        The raters' ``rater_similarity``, ``[C, C]``.
    """
    order = torch.randperm(comparisons.num_cases, generator=generator, device=generator.device)
    raters = order[:_MOST]
    found = specialists(
        single.to(population.device),
        loss,
        comparisons,
        raters,
        steps=steps,
        learning_rate=learning_rate,
        generator=generator,
    )
    margin = margins(found, loss.bank, comparisons, alpha=loss.alpha, discount=loss.discount)
    values = case_values(margin > 0, comparisons)
    chosen = lexicase_selection(values, len(population), epsilon=mad(values), generator=generator)
    population.members.data.update_(found.members.data[chosen].clone())
    return rater_similarity(margin, comparisons, raters)
