"""Which raters want alike, told by a specialist for every rater."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.specialists import specialists
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.models.scoring import case_means, pass_shares, segment_scores
from popl_rl.selection.downsampling import spread_out
from popl_rl.selection.lexicase import lexicase_selection
from popl_rl.selection.mad import mad

__all__ = ["RaterSimilarity", "rater_similarity", "seed_with_specialists"]

_MOST = 256  # specialists; more tell no more, but cost time and memory


@dataclass(frozen=True)
class RaterSimilarity:
    """How alike C raters want: correlations of what S specialists tell of each.

    Rows of the C x C matrix are worked out when they are asked for, so that memory grows with
    the raters and not with their square.

    Attributes:
        profile: What the specialists tell of each rater, columns of norm 1, ``[S, C]``.
    """

    profile: Tensor

    def __len__(self) -> int:
        return self.profile.shape[1]

    def rows(self, raters: Tensor) -> Tensor:
        """Correlations of some raters with all, ``[R] -> [R, C]``, in [-1, 1]."""
        return self.profile[:, raters].T @ self.profile

    def spread_out(self, count: int, *, generator: torch.Generator) -> Tensor:
        """Raters unlike each other, see ``popl_rl.selection.downsampling.spread_out``."""
        return spread_out(self.rows, len(self), count, generator=generator)


def rater_similarity(likelihood: Tensor, raters: Tensor) -> RaterSimilarity:
    """How alike raters want, from how well specialists for some of them explain each.

    Raters of one group are explained well by the same specialists. So the log-likelihoods of a
    rater's answers under all specialists are a profile, and two raters are as close as their
    profiles are correlated. The specialist for a rater says nothing about itself.

    Args:
        likelihood: Mean log-likelihood of each rater's answers under each of the S specialists,
            ``[S, C]``.
        raters: Whom the specialists are for, ``[S]``.

    Returns:
        Correlations; 0 for a rater whom all specialists explain alike.
    """
    place = torch.arange(len(raters), device=raters.device)
    own = likelihood[place, raters]
    # In its own place, what the others have on average.
    others = (likelihood.sum(0)[raters] - own) / max(1, len(raters) - 1)
    profile = likelihood.index_put((place, raters), others)
    profile = profile - profile.mean(0)
    return RaterSimilarity(profile / profile.norm(dim=0).clamp(min=1e-9))


def seed_with_specialists(
    population: Population,
    single: Population,
    loss: CPLLoss,
    comparisons: Comparisons,
    *,
    steps: int = 20,
    learning_rate: float = 1e-2,
    generator: torch.Generator,
) -> RaterSimilarity:
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
        The raters' ``rater_similarity``.
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
    scores = segment_scores(
        found,
        loss.bank,
        alpha=loss.alpha,
        discount=loss.discount,
        wanted=comparisons.segments(len(loss.bank)),
    )
    values = pass_shares(scores, comparisons).values
    chosen = lexicase_selection(values, len(population), epsilon=mad(values), generator=generator)
    population.members.data.update_(found.members.data[chosen].clone())
    return rater_similarity(case_means(scores, comparisons, F.logsigmoid), raters)
