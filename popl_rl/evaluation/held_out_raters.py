"""New raters whose groups nobody looks at: whether a set tells people apart, and its fair choice.

Everything here can be found out about real people too: it takes answers and who gave them.
"""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.measures import new_rater_answers
from popl_rl.keys import RATER
from popl_rl.models.preference_likelihood import InParts, log_likelihood, per_case
from popl_rl.models.scoring import case_values
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import PairPool
from popl_rl.raters.people import Raters

__all__ = ["Gain", "draw_held_out_raters", "favourites", "gain", "met_answers"]


class Gain(NamedTuple):
    """How well a rater's further answers are met.

    Attributes:
        catered: Share that catering by the rater's other answers ranks right, mean over raters.
        alone: Share that the best hypothesis for all ranks right, mean over raters.
        error: Standard error of the mean difference; NaN with a single rater.
    """

    catered: float
    alone: float
    error: float


def draw_held_out_raters(
    groups: Sequence[RaterGroup],
    segment_utility: Tensor,
    *,
    raters: int,
    answers: int,
    shares: Sequence[float] | None,
    pool: PairPool | None = None,
    generator: torch.Generator,
) -> TensorDict:
    """Ask new raters, drawn in the shares of the groups.

    Args:
        groups: G groups.
        segment_utility: Worth of each segment to each group, ``[G, N]``.
        raters: Number of raters R.
        answers: Strict answers K of each.
        shares: Chance of each group; equal if None.
        pool: What pairs are drawn from; all pairs of the N segments if None.
        generator: Source of raters, pairs and answers.

    Returns:
        TensorDict ``[R * K]`` with ``pair``, ``answer`` and ``rater``, rater after rater.

    Raises:
        ValueError: As ``popl_rl.evaluation.measures.new_rater_answers``.
    """
    people = Raters.draw(groups, num_raters=raters, shares=shares, generator=generator)
    said = [
        new_rater_answers(
            groups, group, segment_utility, answers=answers, pool=pool, generator=generator
        )
        for group in people.group_of.tolist()
    ]
    held_out: TensorDict = torch.cat(said)
    return held_out.set(RATER, torch.arange(raters).repeat_interleave(answers))


def favourites(margin: Tensor, comparisons: Comparisons) -> Tensor:
    """The hypothesis that each rater's answers speak for most, as posterior catering chooses.

    Args:
        margin: ``[N, M]``.
        comparisons: M comparisons, a case for each of C raters.

    Returns:
        ``[C]``; the first of all for a rater without answers.
    """
    return per_case(log_likelihood(margin), comparisons).argmax(0)


def met_answers(margin: Tensor | InParts, comparisons: Comparisons) -> Tensor:
    """Share of each rater's answers that are ranked right by what the other half of them chooses.

    Args:
        margin: ``[N, M]``.
        comparisons: M comparisons, a case for each of C raters, each rater's in a row.

    Returns:
        ``[C]``.
    """
    margins = InParts.of(margin)
    half = torch.arange(len(comparisons)) % 2
    belief = torch.zeros(2, margins.members, comparisons.num_cases)
    for part, some in margins.blocks(comparisons):
        likelihood = comparisons.weighted(log_likelihood(some), part)
        for asked in (0, 1):
            chosen = half[part] == asked
            case = comparisons.case[part][chosen]
            belief[asked].index_add_(-1, case, likelihood[:, chosen])
    favourite = belief.argmax(1)
    met = []
    for part, some in margins.blocks(comparisons):
        judge = favourite[1 - half[part], comparisons.case[part]]
        met.append(some.gather(0, judge.unsqueeze(0))[0] > 0)
    return case_values(torch.cat(met).unsqueeze(0), comparisons)[0]


def gain(margin: Tensor, pooled: Tensor | None, comparisons: Comparisons) -> Gain:
    """How much better raters' further answers are met by catering than by one hypothesis for all.

    Each rater's answers are cut in two: a favourite is chosen by one half and judged by the other,
    and the other way round. The one for all is the hypothesis that ranks most answers of the whole
    panel right, among the set and the pooled one. Both are about as good if the set tells nobody
    apart, whether because its members are the same or because they differ in what nobody cares
    about; but also where all people want the same.

    Args:
        margin: ``[N, M]``.
        pooled: ``[M]``, margins of a hypothesis trained on everybody's answers, if there is one.
        comparisons: M comparisons, a case for each of C raters, each rater's in a row.
    """
    passes = margin > 0
    alone = passes if pooled is None else torch.cat([passes, pooled.unsqueeze(0) > 0])
    one_for_all = case_values(alone, comparisons)
    one_for_all = one_for_all[one_for_all.mean(1).argmax()]
    catered = met_answers(margin, comparisons)
    error = float((catered - one_for_all).std() / len(catered) ** 0.5) if len(catered) > 1 else nan
    return Gain(float(catered.mean()), float(one_for_all.mean()), error)
