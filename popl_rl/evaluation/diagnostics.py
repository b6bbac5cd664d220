"""What a reader of a report should not have to find out alone."""

import pandas as pd
import torch

from popl_rl.evaluation.acting import Choosing
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.results import Scoreboard
from popl_rl.keys import OBSERVATION
from popl_rl.raters.condorcet import find_cycle, majority_preference

__all__ = ["alarm", "diagnostics", "left_data", "unexplained", "weak_oracles"]

_WEAK = 0.8  # share of the optimum below which an oracle is no measure of others
_INSIDE = 0.8  # share of a policy's steps inside the data below which it has left them
_ITEMS = 150  # of which three are looked for that a majority prefers in a circle


def diagnostics(board: Scoreboard, evaluator: Evaluator) -> dict[str, str]:
    """Put into words what stands out.

    Args:
        board: What came out.
        evaluator: With the groups and what things are worth to them.

    Returns:
        Sentences by what they are about: ``new raters' further answers``, how well they are met;
        ``alarm`` and ``unexplained raters``, see ``alarm`` and ``unexplained``; ``data``, see
        ``left_data``; ``oracle``, if one is far from the optimum of its group; ``collapse``, if
        groups were given the same hypothesis; ``hidden context``, DPL's detector, if it ran;
        ``majority``, if the groups, pooled in equal shares, prefer states in a circle, so that no
        single utility can say what they want.
    """
    said = {}
    row = _row_of(board.results)
    if row is not None:
        said["new raters' further answers"] = (
            f"{row['further_accuracy']:.1%} ranked right by what their first answers choose, "
            f"{row['one_for_all_accuracy']:.1%} by one hypothesis for all"
        )
    warning = alarm(board.results)
    if warning is not None:
        said["alarm"] = warning
    lost = unexplained(board.results)
    if lost is not None:
        said["unexplained raters"] = lost
    left = left_data(board.results)
    if left is not None:
        said["data"] = left
    weak = weak_oracles(board.results)
    if weak is not None:
        said["oracle"] = weak
    shared: dict[int, list[str]] = {}
    for name, member in board.catered.items():
        shared.setdefault(member, []).append(name)
    together = [" and ".join(names) for names in shared.values() if len(names) > 1]
    if together:
        said["collapse"] = (
            f"{', '.join(together)} were given the same hypothesis: the set does not tell them "
            "apart"
        )
    table = board.results
    context = table[table.measure == "hidden_context"]
    if len(context):
        each = ", ".join(f"{row.method} {row.value:.2f}" for row in context.itertuples())
        said["hidden context (DPL's r², 1 for none)"] = each
    circle = _circle(evaluator)
    if circle is not None:
        said["majority"] = circle
    return said


def alarm(results: pd.DataFrame) -> str | None:
    """Say so if a set serves people no better than one hypothesis for all would.

    It looks at answers of new raters and at no groups, so that it would do the same for people.

    Args:
        results: Rows of a scoreboard.

    Returns:
        A sentence, or None if catering meets further answers better by more than two standard
        errors.
    """
    row = _row_of(results)
    if row is None or row["gain"] > 2 * row["gain_error"]:
        return None
    return (
        "the set meets new raters no better than one hypothesis for all does "
        f"({100 * row['gain']:+.1f} ± {200 * row['gain_error']:.1f} points; "
        f"{row['favourite_share']:.0%} of raters have the same favourite; effectively "
        f"{row['effective']:.1f} members): it tells nobody apart, unless everybody wants the same"
    )


def unexplained(results: pd.DataFrame) -> str | None:
    """Say so if there are raters whom no member of a set explains: a group that it has lost.

    It looks at answers of new raters and at no groups, as ``alarm`` does.

    Args:
        results: Rows of a scoreboard.

    Returns:
        A sentence, or None if there are none, or nothing was measured of them.
    """
    row = _row_of(results)
    if row is None or not row.get("unexplained_share", 0.0) > 0:
        return None
    return (
        f"{row['unexplained_share']:.0%} of new raters are explained by no member: what their "
        f"first answers choose ranks {row['unexplained_accuracy']:.0%} of their further answers "
        f"right, and {row['typical_accuracy']:.0%} of the typical rater's; a group may be lost, "
        "which more raters, more answers or more members (method=popl_niches) may find"
    )


def left_data(results: pd.DataFrame) -> str | None:
    """Say so if policies that groups are given have left the data, see ``DataRegion``.

    Args:
        results: Rows of a scoreboard.

    Returns:
        A sentence, or None if at least 0.8 of each policy's steps are inside the data, or nothing
        was measured of them.
    """
    inside = results[results.measure == "inside_data"]
    gone = inside[inside.value < _INSIDE]
    if gone.empty:
        return None
    each = ", ".join(f"{row.value:.0%} for {row.group}" for row in gone.itertuples())
    return (
        f"policies leave the data: as near to the data as 95% of held-out data are {each} of their "
        "steps; if they fall or stand still, try method.training.bc=100 or 300, a lower "
        "method.training.conservatism, or style codes (method.evolve=code)"
    )


def weak_oracles(results: pd.DataFrame) -> str | None:
    """Say so if oracles are far from the optimum, so that recovery flatters what is compared.

    Args:
        results: Rows of a scoreboard.

    Returns:
        A sentence, or None if every oracle has 0.8 of the optimum or nothing is known of it.
    """
    shares = results[(results.method == "oracle") & (results.measure == "share_of_optimum")]
    weak = shares[shares.value < _WEAK]
    if weak.empty:
        return None
    each = ", ".join(f"{row.value:.2f} for {row.group}" for row in weak.itertuples())
    return (
        f"has a share of the optimum of only {each}: a recovery of 1 is little there; give all "
        "methods more answers or training, and read the share of the optimum instead"
    )


def _row_of(results: pd.DataFrame) -> pd.Series | None:
    """What was measured about the set as a whole, by measure."""
    evaluated = results.method[results.measure == "gain"]
    if evaluated.empty:
        return None
    whole = (results.group == "all") & (results.choice == "")
    chosen = whole & (results.method == evaluated.iloc[0])
    row: pd.Series = results[chosen].set_index("measure")["value"]
    return row


def _circle(evaluator: Evaluator) -> str | None:
    if not isinstance(evaluator.acting, Choosing):
        return None
    segment_utility = evaluator.segment_utility[:, :_ITEMS]
    preferred = majority_preference(segment_utility)
    cycle = find_cycle(preferred)
    if cycle is None:
        return None
    states = evaluator.acting.segments[OBSERVATION][cycle, 0]
    names = ["(" + ", ".join(f"{x:.2f}" for x in state.tolist()) + ")" for state in states]
    ahead = preferred[torch.tensor(cycle), torch.tensor(cycle).roll(-1)].tolist()
    steps = [
        f"{one} to {other} ({share:.0%})"
        for one, other, share in zip(names, names[1:] + names[:1], ahead, strict=True)
    ]
    return f"prefers in a circle: {', '.join(steps)}"
