"""What each group would get of a set if somebody chose from it who knew the group."""

from collections.abc import Sequence

from popl_rl.evaluation.best_of_set import best_of_set
from popl_rl.evaluation.measures import group_returns
from popl_rl.evaluation.results import Performance, Rows

__all__ = ["score_hindsight"]


def score_hindsight(rows: Rows, label: str, done: Performance, accurate: Sequence[int]) -> None:
    """Add what each group would get of its best member, and of its most accurate one.

    Args:
        rows: What is added to.
        label: Name of the method.
        done: What P hypotheses do.
        accurate: Place among these of the one that ranks each group's held-out pairs best.
    """
    rolled, entry = done.episodes, (label, "")
    returns = group_returns(rolled, rows.groups)
    halves = rolled[:, ::2], rolled[:, 1::2] if rolled.shape[1] > 1 else rolled
    best = best_of_set(*(group_returns(half, rows.groups) for half in halves))
    for index, place in enumerate(accurate):
        rows.add_return(entry, index, float(best[index]), prefix="best_")
        rows.add_return(entry, index, float(returns[place, index]), prefix="accurate_")
        if done.exact is not None:
            own = done.exact[:, index]
            rows.add_share(entry, index, float(own.max()), prefix="best_")
            rows.add_share(entry, index, float(own[place]), prefix="accurate_")
