"""How a search divides raters, for each number of niches, and how well that predicts other raters.

Of two populations that have found the same groups, the larger one predicts better all the same,
where answers are few: several members share a group, each errs elsewhere, and a rater's answers
choose among them. That is no reason to count more groups. And a population may have too many
members for some groups and too few for others, whatever its size. So members that rank alike are
merged, one pair after the other, and speak together as an ensemble: a number of niches is judged by
the best division into as many that any population yields.
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
from popl_rl.models.preference_likelihood import answer_likelihood, per_case

__all__ = ["Division", "divisions", "merge", "prediction", "responsibility", "together"]


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
        return together(problem.margins(self.population), self.share, self.niche)


def divisions(
    learnt: Problem, judged: Problem, populations: list[tuple[Population, Tensor]]
) -> list[Division]:
    """The best division of raters for each number of niches.

    Args:
        learnt: What the populations were trained on.
        judged: The answers of the raters whom they have not learnt of.
        populations: Populations of some sizes, and the shares of the raters that their members
            serve.

    Returns:
        A division into one niche, into two, and so on to the size of the largest population.
    """
    best: dict[int, Division] = {}
    for population, share in populations:
        margins = judged.margins(population)
        chance = learnt.margins(population).sigmoid()
        for niche in merge(chance, share):
            value = prediction(together(margins, share, niche), judged.comparisons)
            number = int(niche.max()) + 1
            if number not in best or value.mean() > best[number].value.mean():
                best[number] = Division(population, share, niche, value)
    return [best[number] for number in sorted(best)]


def merge(chance: Tensor, share: Tensor) -> list[Tensor]:
    """Merge members that rank alike, pair by pair, until one niche is left.

    Ward's method (1963): of all pairs of niches, those are merged whose answers differ least, by
    the squares of the differences times ``share_i share_j / (share_i + share_j)``, so that members
    whom few raters need are merged before others.

    Args:
        chance: Chance of each of M answers in the eyes of N members, ``[N, M]``.
        share: Share of the raters that each member serves, ``[N]``, positive.

    Returns:
        The niche of each member, ``[N]``, numbered from 0 on in the order of their first members:
        for N niches, N - 1, ..., 1.
    """
    niches = [[member] for member in range(len(share))]
    weight = share.double().clone()
    apart = torch.cdist(chance.double(), chance.double()).square()
    found = [_numbered(niches, share.device)]
    while len(niches) > 1:
        both = weight.unsqueeze(1) + weight
        cost = apart * weight.unsqueeze(1) * weight / both
        cost.fill_diagonal_(torch.inf)
        first, second = sorted(divmod(int(cost.argmin()), len(niches)))
        # Squared distances from the new centre, without working it out.
        of_first = weight[first] / both[first, second]
        of_second = 1 - of_first
        merged = of_first * apart[first] + of_second * apart[second]
        merged = merged - of_first * of_second * apart[first, second]
        apart[first], apart[:, first] = merged, merged
        apart[first, first] = 0.0
        weight[first] += weight[second]
        rest = [index for index in range(len(niches)) if index != second]
        apart, weight = apart[rest][:, rest], weight[rest]
        niches[first] += niches.pop(second)
        found.append(_numbered(niches, share.device))
    return found


def responsibility(problem: Problem, population: Population, share: Tensor) -> Tensor:
    """E-step: how much each member serves each rater, ``[N, C]``; 0 for raters without answers."""
    comparisons = problem.comparisons
    likelihood = per_case(problem.likelihood(problem.compared_scores(population)), comparisons)
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
    comparisons = comparisons.scaled(scale)
    return predicted(answer_likelihood(scale * margin, comparisons, mistake), comparisons)


def together(margin: Tensor, share: Tensor, niche: Tensor) -> Tensor:
    """Margins of niches: means over their members, by what these serve.

    Args:
        margin: Margins of N members on M comparisons, ``[N, M]``.
        share: Share of the raters that each member serves, ``[N]``, positive.
        niche: Niche of each member, ``[N]``.

    Returns:
        Margins of the K niches that have members, ``[K, M]``.
    """
    weight = F.one_hot(niche).T.to(margin) * share
    weight = weight[weight.sum(1) > 0]
    return weight / weight.sum(1, keepdim=True) @ margin


def _numbered(niches: list[list[int]], device: torch.device) -> Tensor:
    """The number of each member's niche."""
    number = torch.empty(sum(map(len, niches)), dtype=torch.long, device=device)
    for index, members in enumerate(niches):
        number[members] = index
    return number
