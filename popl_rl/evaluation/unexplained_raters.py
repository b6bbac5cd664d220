"""Raters whom no member of a set explains: the trace of a group that was lost.

Nobody's group is looked at, only how often people's further answers are ranked right by what their
first answers choose. A group without a member of its own is met clearly less often than others.
Where wants are a continuum, raters between two members are met a little less often than others,
which is tolerated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.held_out_raters import met_answers
from popl_rl.keys import ANSWER, PAIR, RATER
from popl_rl.models.preference_likelihood import InParts
from popl_rl.randomness import stream
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import PairPool
from popl_rl.raters.people import Raters

__all__ = ["Unexplained", "find_unexplained", "look_for_unexplained"]

_RATERS = 10  # asked for each new rater of a group: a group of 4 % should be among them
_ANSWERS = 200  # of each: enough to tell 0.72 from 0.9
_TOLERATED = 0.1  # of answers met above chance, that raters may be behind the median rater
_FALSE_DISCOVERIES = 0.05


@dataclass(frozen=True)
class Unexplained:
    """How many raters no hypothesis explains.

    Attributes:
        share: Of the raters.
        accuracy: Mean share of these raters' further answers that catering ranks right; NaN where
            there are none.
        typical: The same of the median rater.
    """

    share: float
    accuracy: float
    typical: float

    def measures(self) -> dict[str, float]:
        """The same under the names of measures in a table of results, without what is NaN."""
        found = {"unexplained_share": self.share, "typical_accuracy": self.typical}
        return found | ({"unexplained_accuracy": self.accuracy} if self.share > 0 else {})


def find_unexplained(margin: Tensor | InParts, comparisons: Comparisons) -> Unexplained:
    """Count raters whose answers are met clearly less often than the median rater's.

    Each rater's answers are cut in two, as by ``popl_rl.evaluation.held_out_raters.gain``. A rater
    is unexplained if the answers met are fewer than the median rater's less a tenth of what these
    are above chance, by a binomial test whose rate of false discoveries is 5 % (Benjamini and
    Hochberg, 1995).

    Args:
        margin: Margins of N hypotheses on M comparisons, ``[N, M]``.
        comparisons: M comparisons, a case for each of C raters, each rater's in a row.
    """
    accuracy = met_answers(margin, comparisons)
    typical, answers = float(accuracy.median()), comparisons.sizes()
    least = typical - 2 * _TOLERATED * max(typical - 0.5, 0.0)
    met = (accuracy * answers).round()
    chance = stats.binom.cdf(met.numpy(), answers.numpy(), least)
    lost = torch.from_numpy(stats.false_discovery_control(chance) < _FALSE_DISCOVERIES)
    return Unexplained(float(lost.float().mean()), float(accuracy[lost].mean()), typical)


def look_for_unexplained(
    scores: Tensor,
    groups: Sequence[RaterGroup],
    segment_utility: Tensor,
    *,
    new_raters: int,
    shares: Sequence[float] | None,
    pool: PairPool | None,
    seed: int,
) -> Unexplained:
    """Ask raters of the groups in their shares, and count whom a set does not explain.

    Args:
        scores: Score of every segment in every hypothesis's eyes, ``[P, N]``.
        groups: G groups.
        segment_utility: Utility of each segment to each group, ``[G, N]``.
        new_raters: New raters of each group elsewhere in the evaluation; ten times as many are
            asked here in all.
        shares: Chance of each group; equal if None.
        pool: What pairs are drawn from; all pairs of the N segments if None.
        seed: Seed of the evaluation.
    """
    generator = stream(seed, "unexplained raters")
    pool = PairPool(segment_utility.shape[1]) if pool is None else pool
    people = Raters.draw(
        groups, num_raters=_RATERS * new_raters, shares=shares, generator=generator
    )
    rater = torch.arange(len(people.group_of)).repeat_interleave(_ANSWERS)
    pair = pool.draw(len(rater), generator=generator)
    answer = people.answer(pair, rater, segment_utility, generator=generator)
    said = TensorDict({PAIR: pair, ANSWER: answer, RATER: rater}, [len(rater)])
    asked = Comparisons.from_preferences(said, cases="rater")

    def margins(part: slice) -> Tensor:
        return scores[:, asked.preferred[part]] - scores[:, asked.other[part]]

    # Of a thousand samples of a posterior all at once would be 160 MB, several times.
    return find_unexplained(InParts(len(scores), margins), asked)
