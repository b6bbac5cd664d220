"""How a search divides raters, for each number of niches, and how well that predicts other raters.

Of two populations that have found the same groups, the larger one predicts better all the same,
where answers are few: several members share a group, each errs elsewhere, and a rater's answers
choose among them. That is no reason to count more groups. So a number of niches is judged by the
best that there is for it: the population of that size, or a larger one, members of which speak
together, as an ensemble, wherever they serve the raters of one member of the smaller.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.expectation import expect
from popl_rl.algorithms.needed import predicted
from popl_rl.algorithms.problem import Problem
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.calibration import fit_response
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import log_likelihood, per_case

__all__ = ["Division", "divisions", "merge", "prediction", "responsibility"]


class Division(NamedTuple):
    """Raters divided among niches, in each of which one member or several speak.

    Attributes:
        population: N members.
        share: Share of the raters that each of them serves, ``[N]``.
        niche: Niche of each member, ``[N]``, from 0 on.
        value: Mean log-likelihood of the answers of each rater whom the members have not learnt
            of, ``[C]``; 0 for all others.
    """

    population: Population
    share: Tensor
    niche: Tensor
    value: Tensor

    def margins(self, problem: Problem) -> Tensor:
        """Margins of the niches on the comparisons of a problem, ``[K, M]``."""
        return _together(problem.margins(self.population), self.share, self.niche)

    def served(self, problem: Problem) -> Tensor:
        """How much each niche serves each rater of a problem, ``[K, C]``."""
        each = responsibility(problem, self.population, self.share)
        return F.one_hot(self.niche).T.to(each) @ each


def divisions(
    learnt: Problem, judged: Problem, populations: list[tuple[Population, Tensor]]
) -> list[Division]:
    """The best division of raters into as many niches as each population has members.

    Args:
        learnt: What the populations were trained on.
        judged: The answers of the raters whom they have not learnt of.
        populations: Populations by their sizes, the smallest first, and the shares of the raters
            that their members serve.

    Returns:
        A division for each population.
    """
    margins = [judged.margins(population) for population, _ in populations]
    served = [responsibility(learnt, population, share) for population, share in populations]
    best = []
    for size, few in enumerate(served):
        found = []
        for larger in range(size, len(populations)):
            population, share = populations[larger]
            niche = merge(served[larger], few)
            margin = _together(margins[larger], share, niche)
            value = prediction(margin, judged.comparisons)
            found.append(Division(population, share, niche, value))
        best.append(max(found, key=lambda division: float(division.value.mean())))
    return best


def merge(many: Tensor, few: Tensor) -> Tensor:
    """Which of a few members each of many others speaks together with.

    Args:
        many: How much each of N members serves each rater, ``[N, C]``.
        few: How much each of K members does, ``[K, C]``.

    Returns:
        For each of the many, the one of the few whose raters it serves most, ``[N]``; numbered
        anew, without those that get nobody. Members stay apart if ``many`` is ``few``.
    """
    if many is few:
        return torch.arange(len(many), device=many.device)
    niche: Tensor = (many @ few.T).argmax(1).unique(return_inverse=True)[1]
    return niche


def responsibility(problem: Problem, population: Population, share: Tensor) -> Tensor:
    """E-step: how much each member serves each rater, ``[N, C]``; 0 for raters without answers."""
    comparisons = problem.comparisons
    likelihood = per_case(problem.likelihood(problem.scores(population)), comparisons)
    asked = comparisons.sizes() > 0
    return expect(likelihood, share).responsibility * asked


def prediction(margin: Tensor, comparisons: Comparisons) -> Tensor:
    """How well margins predict each rater, once they are believed as much as they deserve.

    Members are surer of what they have learnt than of other raters, the more so the more they are
    and the more raters err. Scale and slips are fitted to the answers that are predicted: two
    numbers for all of them.

    Args:
        margin: Margins of K niches, ``[K, M]``.
        comparisons: The M comparisons and the case of each.

    Returns:
        Mean log-likelihood of each rater's answers, ``[C]``, see
        ``popl_rl.algorithms.needed.predicted``.
    """
    scale, mistake = fit_response(margin, comparisons)
    return predicted(log_likelihood(scale * margin, mistake), comparisons)


def _together(margin: Tensor, share: Tensor, niche: Tensor) -> Tensor:
    """Margins of niches, means over their members by what these serve, ``[N, M] -> [K, M]``."""
    weight = F.one_hot(niche).T.to(margin) * share
    return weight / weight.sum(1, keepdim=True) @ margin
