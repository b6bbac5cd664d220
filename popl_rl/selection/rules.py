"""Rules of parent selection other than lexicase, to compare it with.

Every rule is a function of the members' values on the cases: who becomes a parent, and nothing
else. The first three see no more of a member than the sum of its values, so that a member that
serves a small group alone has no chance; NSGA-II keeps the cases apart, and ``single_case`` asks
one of them.
"""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Protocol

import torch
from torch import Tensor

from popl_rl.selection.arguments import check_count, check_generator, check_scores
from popl_rl.selection.lexicase import SelectionReport

__all__ = [
    "SELECTIONS",
    "Selection",
    "best_sum_selection",
    "fronts_and_crowding",
    "nsga2_selection",
    "random_selection",
    "report",
    "selection_rule",
    "single_case_selection",
    "tournament_selection",
]


_FEW_CASES = 255  # objectives that moocore, which pymoo calls, can sort by


class Selection(Protocol):
    """Chooses parents by the values of all members on all cases."""

    def __call__(self, values: Tensor, num_selected: int, *, generator: torch.Generator) -> Tensor:
        """Select parents.

        Args:
            values: ``[member, case]``, higher is better.
            num_selected: Parents to select, at least 1; a member may be selected more than once.
            generator: Source of all randomness, on the device of ``values``.

        Returns:
            Row of ``values`` that each selection chose, ``[num_selected]``, int64.
        """
        ...


def tournament_selection(
    values: Tensor, num_selected: int, *, size: int = 4, generator: torch.Generator
) -> Tensor:
    """Tournament selection on the sum of the values: the best of a few random members.

    Args:
        values: ``[member, case]``, higher is better.
        num_selected: Tournaments to hold.
        size: Different members in a tournament; all of them if there are no more.
        generator: Source of the entrants.

    Returns:
        Winners, ``[num_selected]``. Of entrants with equal sums, one that is drawn at random.

    Raises:
        TypeError: A count is not an int.
        ValueError: ``values`` is no matrix of numbers, or a count is below 1.
    """
    _check(values, num_selected, generator)
    check_count("size", size, None)
    count = len(values)
    draw = torch.rand(num_selected, count, generator=generator, device=values.device)
    entrant = draw.argsort(1)[:, :size]
    # The entrants are in a random order, and the first of the best wins.
    winner = values.double().sum(1)[entrant].argmax(1, keepdim=True)
    return entrant.gather(1, winner).squeeze(1)


def best_sum_selection(
    values: Tensor, num_selected: int, *, share: float = 0.25, generator: torch.Generator
) -> Tensor:
    """Truncation selection: parents are drawn uniformly among the best by the sum of the values.

    Args:
        values: ``[member, case]``, higher is better.
        num_selected: Parents to draw.
        share: Share of the members that may become parents, rounded up.
        generator: Source of the draws.

    Returns:
        Parents, ``[num_selected]``.

    Raises:
        TypeError: ``num_selected`` is not an int.
        ValueError: ``values`` is no matrix of numbers, ``num_selected`` is below 1, or ``share`` is
            not in (0, 1].
    """
    _check(values, num_selected, generator)
    if not 0 < share <= 1:
        raise ValueError(f"share must be in (0, 1], got {share}")
    most = -int(-share * len(values) // 1)
    best = values.double().sum(1).argsort(descending=True, stable=True)[:most]
    return best[_draw(most, (num_selected,), values, generator)]


def single_case_selection(
    values: Tensor, num_selected: int, *, generator: torch.Generator
) -> Tensor:
    """The best on a single random case, a draw among those equally good: lexicase's first step.

    What lexicase gains over this, it gains by going on to further cases.

    Args:
        values: ``[member, case]``, higher is better.
        num_selected: Parents to select, each for a case of its own.
        generator: Source of the cases and of the draws.

    Returns:
        Parents, ``[num_selected]``.

    Raises:
        TypeError: ``num_selected`` is not an int.
        ValueError: ``values`` is no matrix of numbers, or ``num_selected`` is below 1.
    """
    _check(values, num_selected, generator)
    case = _draw(values.shape[1], (num_selected,), values, generator)
    asked = values.T[case]
    is_best = asked == asked.amax(1, keepdim=True)
    ticket = torch.rand(is_best.shape, generator=generator, device=values.device)
    return ticket.masked_fill(~is_best, -1.0).argmax(1)


def random_selection(values: Tensor, num_selected: int, *, generator: torch.Generator) -> Tensor:
    """Parents are drawn uniformly: no selection at all.

    Args:
        values: ``[member, case]``; only the number of members matters.
        num_selected: Parents to draw.
        generator: Source of the draws.

    Returns:
        Parents, ``[num_selected]``.

    Raises:
        TypeError: ``num_selected`` is not an int.
        ValueError: ``values`` is no matrix of numbers, or ``num_selected`` is below 1.
    """
    _check(values, num_selected, generator)
    return _draw(len(values), (num_selected,), values, generator)


def nsga2_selection(values: Tensor, num_selected: int, *, generator: torch.Generator) -> Tensor:
    """Mating selection of NSGA-II (Deb et al., 2002, doi 10.1109/4235.996017), by pymoo.

    Every case is an objective. Members are sorted into non-dominated fronts, and within a front by
    crowding distance; parents win binary tournaments on the front, then on the distance. With many
    more cases than members hardly anybody is dominated, so that crowding decides alone.

    Args:
        values: ``[member, case]``, higher is better.
        num_selected: Tournaments to hold.
        generator: Source of the entrants.

    Returns:
        Winners, ``[num_selected]``. Of entrants that are equal, the one drawn first.

    Raises:
        TypeError: ``num_selected`` is not an int.
        ValueError: ``values`` is no matrix of numbers, ``num_selected`` is below 1, or pymoo is not
            installed.
    """
    _check(values, num_selected, generator)
    front, crowding = fronts_and_crowding(values)
    pair = _draw(len(values), (num_selected, 2), values, generator)
    (first, second), (one, other) = front[pair].T, crowding[pair].T
    second_wins = (second < first) | ((second == first) & (other > one))
    return pair.gather(1, second_wins.long().unsqueeze(1)).squeeze(1)


def fronts_and_crowding(values: Tensor) -> tuple[Tensor, Tensor]:
    """Sort members into non-dominated fronts, as NSGA-II does (Deb et al., 2002).

    Args:
        values: ``[member, case]``, higher is better.

    Returns:
        Front of each member, counted from 0, ``[member]``, and its crowding distance among the
        members of that front, ``[member]``, infinite at the ends.

    Raises:
        ValueError: If pymoo is not installed.
    """
    _require_pymoo()
    from pymoo.operators.survival.rank_and_crowding.metrics import calc_crowding_distance
    from pymoo.util.dominator import Dominator
    from pymoo.util.nds.non_dominated_sorting import NonDominatedSorting

    costs = -values.double().cpu().numpy()  # pymoo minimises
    # What pymoo calls for speed refuses more cases; with a dominator it compares pairs itself.
    dominator = Dominator() if costs.shape[1] > _FEW_CASES else None
    fronts, rank = NonDominatedSorting(dominator=dominator).do(costs, return_rank=True)
    crowding = torch.empty(len(values), dtype=torch.float64)
    for members in fronts:
        crowding[members] = torch.from_numpy(calc_crowding_distance(costs[members]))
    return torch.as_tensor(rank, device=values.device), crowding.to(values.device)


def _require_pymoo() -> None:
    if find_spec("pymoo") is None:
        raise ValueError(
            "selection 'nsga2' needs pymoo, which is not installed; pip install "
            "'popl_rl[benchmark]', or choose another selection"
        )


SELECTIONS: dict[str, Callable[..., Tensor]] = {
    "tournament": tournament_selection,
    "best_sum": best_sum_selection,
    "random": random_selection,
    "single_case": single_case_selection,
    "nsga2": nsga2_selection,
}
"""Rules by name."""


def selection_rule(name: str, *, tournament: int = 4) -> Selection | None:
    """Rule of a name; None stands for lexicase selection.

    Args:
        name: ``"lexicase"`` or a key of ``SELECTIONS``.
        tournament: Members in a tournament.

    Raises:
        ValueError: If there is no such rule, or it needs pymoo and that is not installed.
    """
    if name == "lexicase":
        return None
    if name not in SELECTIONS:
        known = ", ".join(["lexicase", *SELECTIONS])
        raise ValueError(f"selection must be one of {known}, got {name!r}")
    if name == "nsga2":
        _require_pymoo()  # before a run has done all but select
    if name == "tournament":
        return partial(tournament_selection, size=tournament)
    return SELECTIONS[name]


def report(values: Tensor, parents: Tensor) -> SelectionReport:
    """How a selection without orders of cases went.

    Args:
        values: ``[member, case]``.
        parents: Row of ``values`` that each selection chose, ``[num_selected]``.

    Returns:
        The report that lexicase selection gives, with a depth of 0.
    """
    labels = torch.unique(values, dim=0, return_inverse=True)[1]
    shares = labels[parents].bincount() / len(parents)
    return SelectionReport(
        parents=parents,
        depth=torch.zeros_like(parents),
        distinct=int(labels.max()) + 1,
        effective=1 / float(shares.square().sum()),
    )


def _check(values: Tensor, num_selected: int, generator: torch.Generator) -> None:
    check_scores(values, "values")
    check_count("num_selected", num_selected, None)
    check_generator(generator, values.device, "values")


def _draw(count: int, shape: tuple[int, ...], values: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randint(count, shape, generator=generator, device=values.device)
