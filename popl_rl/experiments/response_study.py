"""How people on a delivery grid answer, as the response model of simulated raters has it."""

from collections.abc import Iterator
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from popl_rl.data.tables import solve
from popl_rl.experiments.people import People
from popl_rl.keys import ANSWER, PAIR, RATER, REWARD, Answer

__all__ = ["fit_response", "fit_ties", "person_fits", "response_fits"]

_DISCOUNT = 0.999


def response_fits(people: People, grid: Any, walks: Tensor) -> pd.DataFrame:
    """How the people of each condition answer.

    For each condition the partial return and the regret of the two segments are known exactly, and
    strict answers are fitted by both.

    Args:
        people: Everybody; with conditions.
        grid: The delivery grid.
        walks: Number of the state and action of each step of each segment, ``[N, T]`` (state times
            actions plus action).

    Returns:
        Rows ``group, label, rationality, mistake, log_likelihood, answers``.
    """
    rows = []
    for group in [*sorted({*people.groups} - {""}), "all"]:
        chosen = torch.tensor([group in (name, "all") for name in people.groups])
        own = people.answers.rows(chosen[people.answers.case].nonzero()[:, 0])
        for label, score in _segment_utilities(people, grid, walks):
            difference = score[own.preferred] - score[own.other]
            rows.append((group, label, *fit_response(difference), len(own)))
    columns = ["group", "label", "rationality", "mistake", "log_likelihood", "answers"]
    return pd.DataFrame(rows, columns=columns)


def person_fits(people: People, grid: Any, walks: Tensor) -> pd.DataFrame:
    """How each person who is known by an id answers: rationality, slips and ties.

    Of partial return and regret, a person is taken to look at what makes the strict answers
    likelier.

    Args:
        people: Everybody.
        grid: The delivery grid.
        walks: As of ``response_fits``.

    Returns:
        Rows ``person, group, label, rationality, mistake, log_likelihood, ties, tie, tie_error``:
        the share of ties, and of ``fit_ties`` the threshold and the share that it gets wrong.
    """
    preferences = people.data.preferences
    pair, answer, rater = preferences[PAIR], preferences[ANSWER], preferences[RATER]
    utilities = list(_segment_utilities(people, grid, walks))
    named = people.data.names.raters
    group = dict(zip(people.names, people.groups, strict=True))
    rows = []
    for code in rater[rater >= 0].unique().tolist():
        own = (rater == code) & (answer <= Answer.TIE)
        strict = own & (answer <= Answer.SECOND)
        sign = 2.0 * answer[strict] - 1
        fits = []
        for label, score in utilities:
            difference = score[pair[:, 1]] - score[pair[:, 0]]
            found = fit_response(sign * difference[strict])
            fits.append((found[2], label, found, difference[own]))
        likely, label, found, difference = max(fits, key=lambda fit: fit[0])
        is_tie = answer[own] == Answer.TIE
        person = named[code] if named else str(code)
        tie, error = fit_ties(difference, is_tie)
        share = float(is_tie.float().mean())
        rows.append((person, group.get(person, ""), label, *found[:2], likely, share, tie, error))
    columns = ["person", "group", "label", "rationality", "mistake", "log_likelihood"]
    return pd.DataFrame(rows, columns=[*columns, "ties", "tie", "tie_error"])


def _segment_utilities(people: People, grid: Any, walks: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Partial return and negated regret of each segment, ``[N]``, by label."""
    table = grid.transition_table()
    reward = table.steps[REWARD]
    mask = people.bank.mask
    there = torch.ones_like(walks, dtype=torch.bool) if mask is None else mask
    for label, value in (
        ("return", reward),
        ("regret", solve(table, reward, discount=_DISCOUNT)[0]),
    ):
        yield label, (value.flatten()[walks] * there).sum(1)


def fit_response(difference: Tensor) -> tuple[float, float, float]:
    """Rationality and slips under which strict answers are likeliest.

    The likelihood ``(1 - slip) sigmoid(beta d) + slip sigmoid(-beta d)`` is maximised on a grid of
    rationalities beta from 0.01 to 10 and of slips from 0 to 0.4.

    Args:
        difference: Utility of what was preferred less that of the other, ``[M]``.

    Returns:
        Rationality, chance of a slip, and mean log-likelihood.
    """
    beta = torch.logspace(-2, 1, 31).view(-1, 1, 1)
    slip = torch.linspace(0, 0.4, 21).view(1, -1, 1)
    chance = (1 - slip) * (beta * difference).sigmoid() + slip * (-beta * difference).sigmoid()
    likely = chance.clamp(min=1e-12).log().mean(-1)
    place = int(likely.argmax())
    row, column = divmod(place, likely.shape[1])
    return float(beta[row, 0, 0]), float(slip[0, column, 0]), float(likely[row, column])


def fit_ties(difference: Tensor, is_tie: Tensor) -> tuple[float, float]:
    """Threshold under which differences are taken for ties, as by simulated raters.

    Args:
        difference: Difference of the two utilities, ``[M]``.
        is_tie: Which answers are ties, ``[M]`` bool.

    Returns:
        The threshold that gets the fewest answers wrong, the smallest of equals, and the share that
        it gets wrong; it is NaN if calling nothing a tie is as good.
    """
    size = difference.abs()
    threshold = torch.cat([size.new_tensor([-1.0]), size.unique()])
    wrong = ((size <= threshold.unsqueeze(1)) != is_tie).float().mean(1)
    best = int(wrong.argmin())
    return float(threshold[best]) if best else float("nan"), float(wrong[best])
