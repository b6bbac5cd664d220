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
from popl_rl.selection.pools import Epsilon, PassPools, Round, ScorePools, select_dynamically

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

    scores, tolerance = _prepare(scores.detach(), epsilon, epsilon_mode)
    labels, first = _label_behaviours(scores)
    behaviours = scores if len(first) == len(scores) else scores[first]
    limit = num_cases if cases_per_selection is None else cases_per_selection
    if epsilon_mode == "dynamic" and epsilon == "mad" and tolerance is not None:
        parents, depth = select_dynamically(
            scores, labels, num_selected, limit=limit, generator=generator
        )
        chosen = labels[parents]
    else:
        twins = labels.bincount()
        if scores.dtype == torch.bool:
            pools: PassPools | ScorePools = PassPools(behaviours)
        else:
            bars = None if tolerance is None else Epsilon(tolerance, scores)
            pools = ScorePools(behaviours, bars)
        chosen, depth = Round(pools, twins, limit=limit, generator=generator).select(num_selected)
        parents = chosen
        if len(first) < len(scores):
            # Members sorted by behaviour, and a place among those of the chosen one.
            draw = torch.rand(
                num_selected, generator=generator, device=scores.device, dtype=torch.float64
            )
            place = (twins.cumsum(0) - twins)[chosen] + (draw * twins[chosen]).long()
            parents = labels.argsort(stable=True)[place]
    shares = chosen.bincount() / num_selected
    return SelectionReport(
        parents=parents,
        depth=depth,
        distinct=len(first),
        effective=1 / float(shares.square().sum()),
    )


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
    tolerance = _tolerance(0.0 if epsilon is None else epsilon, scores)
    values = scores.to(tolerance.dtype)
    parents, depth = torch.empty_like(first), torch.empty_like(first)
    cases, group = first.unique(return_inverse=True)
    for number, case in enumerate(cases.tolist()):
        column = values[:, case]
        pool = (column >= column.max() - tolerance[case]).nonzero().squeeze(-1)
        mine = (group == number).nonzero().squeeze(-1)
        # Coming back to the first case removes nobody, so the pool may meet all cases.
        rest = lexicase_report(values[pool], len(mine), epsilon=tolerance, generator=generator)
        parents[mine] = pool[rest.parents]
        depth[mine] = rest.depth + int(len(pool) < len(scores))
    labels, behaviours = _label_behaviours(scores)
    shares = labels[parents].bincount() / len(parents)
    return SelectionReport(parents, depth, len(behaviours), 1 / float(shares.square().sum()))


def _prepare(
    scores: Tensor, epsilon: float | Tensor | str | None, mode: str
) -> tuple[Tensor, Tensor | None]:
    """Reduce the kinds of scores and epsilon to passes, or real scores and a tolerance per case.

    The tolerance is NaN where the median absolute deviation is still to be worked out, and None
    for plain lexicase selection.
    """
    if scores.dtype in (torch.float16, torch.bfloat16):
        scores = scores.float()
    if epsilon is None:
        return scores, None
    tolerance = _tolerance(epsilon, scores)
    if scores.dtype == torch.bool:
        # A fail trails a pass by 1, and the median absolute deviation of passes is at most 1/2.
        return scores | (tolerance >= 1), None
    scores = scores.to(tolerance.dtype)
    if mode != "static":
        return scores, tolerance
    everywhere = torch.arange(scores.shape[1], device=scores.device)
    return scores >= scores.amax(0) - Epsilon(tolerance, scores).at(everywhere), None


def _tolerance(epsilon: float | Tensor | str, scores: Tensor) -> Tensor:
    """Check epsilon and spread it over the cases, ``[case]``."""
    num_cases = scores.shape[1]
    dtype = scores.dtype if scores.dtype.is_floating_point else torch.float64
    if isinstance(epsilon, str):
        if epsilon != "mad":
            raise ValueError(f"epsilon must be a number, a tensor, 'mad' or None, got {epsilon!r}")
        if dtype == scores.dtype and any(bool(end.isinf()) for end in scores.aminmax()):
            raise ValueError(
                "scores must be finite if epsilon is 'mad', got infinite ones; clamp them or give "
                "epsilon as a number"
            )
        return torch.full((num_cases,), torch.nan, dtype=dtype, device=scores.device)
    if isinstance(epsilon, bool) or not isinstance(epsilon, (int, float, Tensor)):
        raise TypeError(
            f"epsilon must be a number, a tensor, 'mad' or None, got {type(epsilon).__name__}"
        )
    tolerance = torch.as_tensor(epsilon, dtype=dtype, device=scores.device).detach()
    if tolerance.ndim and tolerance.shape != (num_cases,):
        raise ValueError(
            f"epsilon must be a number or one tolerance per case, shape ({num_cases},), got shape "
            f"{tuple(tolerance.shape)}"
        )
    tolerance = tolerance.expand(num_cases)
    if not bool((tolerance >= 0).all()) or bool(tolerance.isinf().any()):
        raise ValueError(
            f"epsilon must be finite and at least 0, got {float(tolerance.min())} to "
            f"{float(tolerance.max())}"
        )
    return tolerance


def _label_behaviours(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Number the distinct rows: label of each member, and the first member with each label."""
    num_members, num_cases = scores.shape
    everyone = torch.arange(num_members, device=scores.device)
    for width in (256, num_cases):  # a few cases mostly suffice to tell everybody apart
        labels: Tensor = torch.unique(_fingerprints(scores[:, :width]), return_inverse=True)[1]
        if int(labels.max()) + 1 == num_members:
            return everyone, everyone
        if width >= num_cases:
            break
    first = _first_with(labels)
    twins = (first[labels] != everyone).nonzero().view(-1)
    for some in torch.split(twins, _rows_at_once(scores)):
        if not torch.equal(scores[some], scores[first[labels[some]]]):  # fingerprints have clashed
            labels = torch.unique(scores, dim=0, return_inverse=True)[1]
            return labels, _first_with(labels)
    return labels, first


def _first_with(labels: Tensor) -> Tensor:
    """First member with each label."""
    everyone = torch.arange(len(labels), device=labels.device)
    return everyone.new_zeros(int(labels.max()) + 1).scatter_reduce(
        0, labels, everyone, "amin", include_self=False
    )


def _fingerprints(scores: Tensor) -> Tensor:
    """Hash each row to 64 bits, ``[member]``: a random linear function of its 8-byte words."""
    generator = torch.Generator().manual_seed(0)  # the result must not depend on the caller's
    num_bytes = scores.shape[1] * scores.element_size()
    shape = (-(-num_bytes // 8),)
    factors = torch.randint(-(2**63), 2**63 - 1, shape, generator=generator).to(scores.device)
    prints = []
    for part in torch.split(scores, _rows_at_once(scores)):
        if part.dtype.is_floating_point:
            part = part + 0.0  # -0.0 equals 0.0 but has other bits
        words = part.contiguous().view(torch.uint8)
        if num_bytes % 8:
            words = torch.nn.functional.pad(words, (0, -num_bytes % 8))
        words = words.view(torch.int64)
        # A product keeps the low bits of a word apart, not the high ones: fold those in first.
        prints.append(((words ^ ((words >> 32) & 0xFFFFFFFF)) * factors).sum(1))
    return torch.cat(prints)


def _rows_at_once(scores: Tensor) -> int:
    """Rows that fit into a processor's cache together, at least one."""
    return max(1, 2**19 // (scores.shape[1] * scores.element_size()))
