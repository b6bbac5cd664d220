"""What several searches agree upon: niches that most of them have found, each from other raters.

Each search divides raters on its own, and each errs elsewhere: it loses a group, or finds one
twice. What has been found by most of them, though they have learnt of different raters, is there.
So, for each number of niches, the niches of all searches are joined into as many, those that rank
alike first, and whatever a minority has found alone is dropped. The raters of whom a search has not
learnt are predicted by its own members only.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.divisions import Division, merge, prediction, responsibility
from popl_rl.algorithms.problem import Problem
from popl_rl.models.calibration import scale_for_strangers
from popl_rl.models.population import Population

__all__ = ["Agreement", "agreements"]


class Agreement(NamedTuple):
    """Niches that most searches have found.

    Attributes:
        parts: Of each search the members that speak in these niches, which are numbered alike in
            all parts; a search may have nobody in some of them.
        value: Mean log-likelihood of the answers of each rater, as predicted by the search that has
            not learnt of them, ``[C]``.
        found: Niches into which each search had divided the raters.
    """

    parts: list[Division]
    value: Tensor
    found: int

    @property
    def number(self) -> int:
        """How many niches there are, K."""
        return 1 + max(int(part.niche.max()) for part in self.parts)

    def served(self, problem: Problem) -> Tensor:
        """How much each niche serves each rater of a problem, ``[K, C]``, summing to 1 over K."""
        members = torch.cat([part.population.members.data for part in self.parts])
        population: Population = self.parts[0].population.with_members(members)
        share = torch.cat([part.share for part in self.parts])
        each = responsibility(problem, population, share / share.sum())
        niche = torch.cat([part.niche for part in self.parts])
        return F.one_hot(niche).T.to(each) @ each

    def scale(self, judged: list[Problem]) -> float:
        """How much scores are to be believed by people whom nobody has learnt of.

        Args:
            judged: Of each search the answers of the raters whom it has not learnt of.

        Returns:
            See ``popl_rl.models.calibration.scale_for_strangers``.
        """
        parts = zip(self.parts, judged, strict=True)
        margins = [part.margins(problem) for part, problem in parts]
        return scale_for_strangers(margins, [problem.comparisons for problem in judged])


def agreements(
    problem: Problem, judged: list[Problem], divided: list[list[Division]]
) -> list[Agreement]:
    """What searches agree upon, for each number of niches that comes out.

    Args:
        problem: What is to be learnt, all raters of it.
        judged: Of each search the answers of the raters whom it has not learnt of, who are nobody
            else's.
        divided: Of each search its division into one niche, into two, and so on.

    Returns:
        The agreement that predicts raters best for each number of niches, by growing numbers.
    """
    best: dict[int, Agreement] = {}
    for divisions in zip(*divided, strict=False):
        one = _agreement(problem, judged, list(divisions))
        if one is None:
            continue
        number = one.number
        if number not in best or one.value.mean() > best[number].value.mean():
            best[number] = one
    return [best[number] for number in sorted(best)]


def _agreement(
    problem: Problem, judged: list[Problem], divisions: list[Division]
) -> Agreement | None:
    """Join niches of all searches into as many as each has; None if one shares nothing at all."""
    count = [int(division.niche.max()) + 1 for division in divisions]
    chance = torch.cat([division.margins(problem).sigmoid() for division in divisions])
    share = torch.cat([_served(division) for division in divisions])
    joined = merge(chance, share)[-count[0]].split(count)
    there = torch.stack([F.one_hot(own, count[0]).amax(0) for own in joined])
    common = there.sum(0) > len(divisions) / 2
    number = torch.where(common, common.cumsum(0) - 1, -1)
    niches = [number[own][one.niche] for own, one in zip(joined, divisions, strict=True)]
    if any(bool((niche < 0).all()) for niche in niches):
        return None
    parts = [_those(one, niche) for one, niche in zip(divisions, niches, strict=True)]
    predicted = [
        prediction(part.margins(others), others.comparisons)
        for part, others in zip(parts, judged, strict=True)
    ]
    return Agreement(parts, torch.stack(predicted).sum(0), count[0])


def _served(division: Division) -> Tensor:
    """Share of the raters that each niche of a division serves, summing to 1."""
    share = F.one_hot(division.niche).T.to(division.share) @ division.share
    return share / share.sum()


def _those(division: Division, niche: Tensor) -> Division:
    """The members of a division that have a niche, of the numbers given; -1 for those without."""
    members = (niche >= 0).nonzero()[:, 0]
    return division._replace(
        population=division.population.subset(members.tolist()),
        share=(division.share / division.share.sum())[members],
        niche=niche[members],
    )
