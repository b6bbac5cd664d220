"""Lexicase selection: each parent is the best member under a random order of the cases of its own.

One selection takes the cases in a random order and keeps, case after case, the members that are
best on it among those still in the pool, until one is left; a final tie is broken at random
(Spector, 2012; Helmuth, Spector and Matheson, 2014, doi 10.1109/TEVC.2014.2362729). So every parent
is Pareto-optimal within the population. On real scores "best" may be relaxed to "within epsilon of
the best" (La Cava, Spector and Danai, 2016; La Cava et al., 2019, doi 10.1162/evco_a_00224).

Parents are drawn from exactly that distribution, but without walking through the orders:

* Members with equal rows share one *behaviour*. Behaviours compete; the parent is drawn at the end
  among the members of the one that wins.
* Cases on which all members agree are set aside.
* Orders grow case by case, because a few tens of cases decide even among 100 000. Cases are drawn
  *with* replacement: one that comes back meets only members that it has already let through and
  changes nothing, and the first appearances alone form a uniformly random order.
* All selections advance together on compact pools (`popl_rl.selection.pools`).
* Once the members left are so alike that draws hardly ever part them, the next case is drawn among
  those that do part them: any of these is equally likely to be the first in a random order.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from popl_rl.selection.arguments import check_count, check_generator, check_scores
from popl_rl.selection.behaviours import label_behaviours
from popl_rl.selection.dynamic_epsilon import select_dynamically
from popl_rl.selection.epsilon import Epsilon, prepare_scores
from popl_rl.selection.pools import PassPools, ScorePools
from popl_rl.selection.rounds import Round

__all__ = ["SelectionReport", "lexicase_given_first", "lexicase_report", "lexicase_selection"]


@dataclass(frozen=True, eq=False)
class SelectionReport:
    """Parents, and how their selection went.

    Attributes:
        parents: Row of ``scores`` that each selection chose, ``[num_selected]``, int64.
        depth: Cases each selection used: the place, in its random order, of the last case that
            removed a member, ``[num_selected]``, int64. 0 if no case removed anybody.
        distinct: Number of distinct behaviours in the population, that is of distinct rows of
            ``scores`` (with ``epsilon_mode="static"``: of distinct rows of passes).
        effective: Effective number of behaviours among the parents, ``1 / sum(p ** 2)`` where p
            is a behaviour's share of the parents: 1 if all parents behave alike, k if k behaviours
            have equal shares.
    """

    parents: Tensor
    depth: Tensor
    distinct: int
    effective: float


def lexicase_selection(
    scores: Tensor,
    num_selected: int,
    *,
    epsilon: float | Tensor | Literal["mad"] | None = None,
    epsilon_mode: Literal["static", "semi-dynamic", "dynamic"] = "semi-dynamic",
    cases_per_selection: int | None = None,
    generator: torch.Generator,
) -> Tensor:
    """Select parents by lexicase selection.

    Args:
        scores: ``[member, case]``, bool (passes) or real, higher is better. Infinite scores are
            allowed unless epsilon is ``"mad"``. Give passes as bool: that is much the fastest.
        num_selected: Parents to select, at least 1; a member may be selected more than once.
        epsilon: How far behind the best a member may be and still stay in the pool, at least 0: a
            number, a tensor ``[case]``, or ``"mad"``, for each case the median absolute deviation
            of its scores over the whole population (members, not behaviours; with an even number
            of values the median is the mean of the two middle ones). The default, None, is plain
            lexicase selection, as is 0.
        epsilon_mode: Whom members are compared with if there is an epsilon, in the terms of La
            Cava et al. (2019).
            ``"static"``: the population; scores become passes (score at least the best in the
            population minus epsilon), and plain lexicase selection runs on those.
            ``"semi-dynamic"``: the pool; a case keeps the members whose score is at least the
            best score left in the pool minus epsilon, which is the population's.
            ``"dynamic"``: the pool, and ``"mad"`` too is the pool's. Selections then run one
            after the other, which is tens of times slower. With any other epsilon the same as
            ``"semi-dynamic"``.
        cases_per_selection: If given, each selection sees only a random subset of this many cases,
            drawn anew for each (down-sampling per selection). None: all of them.
        generator: Source of all randomness, on the device of ``scores``.

    Returns:
        Row of ``scores`` that each selection chose, ``[num_selected]``, int64.

    Raises:
        TypeError: An argument is of the wrong type, or ``scores`` of a dtype without an order.
        ValueError: ``scores`` is not a matrix, is empty or contains NaN; ``num_selected`` or
            ``cases_per_selection`` is out of range; ``epsilon`` is negative, not finite or not one
            per case; ``epsilon_mode`` is unknown; or ``generator`` is on another device.

    Example:
        >>> passes = torch.tensor([[True, True, False], [False, False, True], [False, True, False]])
        >>> generator = torch.Generator().manual_seed(0)
        >>> parents = lexicase_selection(passes, 100, generator=generator)
        >>> sorted(set(parents.tolist()))  # member 2 is dominated by member 0
        [0, 1]
    """
    return lexicase_report(
        scores,
        num_selected,
        epsilon=epsilon,
        epsilon_mode=epsilon_mode,
        cases_per_selection=cases_per_selection,
        generator=generator,
    ).parents


def lexicase_report(
    scores: Tensor,
    num_selected: int,
    *,
    epsilon: float | Tensor | Literal["mad"] | None = None,
    epsilon_mode: Literal["static", "semi-dynamic", "dynamic"] = "semi-dynamic",
    cases_per_selection: int | None = None,
    generator: torch.Generator,
) -> SelectionReport:
    """Select parents as `lexicase_selection` does, and say how it went.

    Takes the same arguments, raises the same errors and, from the same state of the generator,
    selects the same parents.

    Returns:
        The parents, the depth of each selection, and how many behaviours there are.
    """
    check_scores(scores)
    num_cases = scores.shape[1]
    check_count("num_selected", num_selected, None)
    if cases_per_selection is not None:
        check_count("cases_per_selection", cases_per_selection, num_cases)
    if epsilon_mode not in ("static", "semi-dynamic", "dynamic"):
        raise ValueError(
            f"epsilon_mode must be 'static', 'semi-dynamic' or 'dynamic', got {epsilon_mode!r}; "
            "use 'semi-dynamic' to compare with the best of the remaining pool"
        )
    check_generator(generator, scores.device)

    scores, tolerance = prepare_scores(scores.detach(), epsilon, epsilon_mode)
    limit = num_cases if cases_per_selection is None else cases_per_selection
    if epsilon_mode == "dynamic" and epsilon == "mad" and tolerance is not None:
        labels, first = label_behaviours(scores)
        parents, depth = select_dynamically(
            scores, labels, num_selected, limit=limit, generator=generator
        )
        return _report(parents, labels[parents], depth, len(first))
    return _select(scores, tolerance, num_selected, limit=limit, generator=generator)


def lexicase_given_first(
    scores: Tensor,
    first: Tensor,
    *,
    epsilon: Tensor | float | None = None,
    generator: torch.Generator,
) -> SelectionReport:
    """Select parents in random orders of which the first case is given.

    With ``first`` drawn uniformly, parents are distributed as those of `lexicase_selection` with
    the same (semi-dynamic) epsilon.

    Args:
        scores: ``[member, case]``, as for `lexicase_selection`.
        first: Case that each selection begins with, ``[num_selected]``, int64.
        epsilon: How far behind the best a member may be: a number, a tensor ``[case]``, or None.
        generator: Source of all randomness, on the device of ``scores``.

    Returns:
        The parents in the order of ``first``, and how their selection went.

    Raises:
        TypeError: As `lexicase_selection`.
        ValueError: As `lexicase_selection`, or if a first case does not exist.
    """
    check_scores(scores)
    num_cases = scores.shape[1]
    if first.ndim != 1 or not len(first) or not bool(((first >= 0) & (first < num_cases)).all()):
        raise ValueError(f"first must hold cases in 0..{num_cases - 1}, [selection], got {first}")
    check_generator(generator, scores.device)
    scores, tolerance = prepare_scores(scores.detach(), epsilon, "semi-dynamic")
    return _select(scores, tolerance, len(first), limit=num_cases, first=first, generator=generator)


def _select(
    scores: Tensor,
    tolerance: Tensor | None,
    num_selected: int,
    *,
    limit: int,
    first: Tensor | None = None,
    generator: torch.Generator,
) -> SelectionReport:
    """Select among behaviours, then a member of each that was chosen."""
    labels, representative = label_behaviours(scores)
    distinct = len(representative)
    behaviours = scores if distinct == len(scores) else scores[representative]
    twins = labels.bincount()
    if scores.dtype == torch.bool:
        pools: PassPools | ScorePools = PassPools(behaviours)
    else:
        pools = ScorePools(behaviours, None if tolerance is None else Epsilon(tolerance, scores))
    turns = Round(pools, twins, limit=limit, generator=generator)
    chosen, depth = turns.select(num_selected, first)
    parents = chosen
    if distinct < len(scores):
        # Members sorted by behaviour, and a place among those of the chosen one.
        draw = torch.rand(
            num_selected, generator=generator, device=scores.device, dtype=torch.float64
        )
        place = (twins.cumsum(0) - twins)[chosen] + (draw * twins[chosen]).long()
        parents = labels.argsort(stable=True)[place]
    return _report(parents, chosen, depth, distinct)


def _report(parents: Tensor, chosen: Tensor, depth: Tensor, distinct: int) -> SelectionReport:
    """The report on parents, of which the behaviours are ``chosen``."""
    shares = chosen.bincount() / len(chosen)
    return SelectionReport(parents, depth, distinct, 1 / float(shares.square().sum()))
