"""What is said of a group follows from returns and their errors; and who was lost is noticed."""

import pandas as pd
import pytest
import torch
from tensordict import TensorDict

from popl_rl.evaluation.diagnostics import unexplained
from popl_rl.evaluation.statistics import RESULT_COLUMNS
from popl_rl.evaluation.unexplained_raters import look_for_unexplained
from popl_rl.evaluation.verdicts import DATA, FEW, LOST, ORACLE, PARTLY, SERVED, verdicts
from popl_rl.raters.groups import make_groups
from popl_rl.raters.response import Response


def table(**returns):
    """Rows of one group: return of each method, with an error of 1 if it is a number alone."""
    rows = []
    for method, value in returns.items():
        mean, error = value if isinstance(value, tuple) else (value, 1.0)
        choice = "posterior" if method == "popl" else ""
        rows += [(method, choice, "fast", "return", mean)]
        rows += [(method, choice, "fast", "return_error", error)]
    return pd.DataFrame(rows, columns=RESULT_COLUMNS)


@pytest.mark.parametrize(
    ("word", "best", "returns"),
    [
        (SERVED, "its oracle", {"popl": 95, "oracle": 100}),
        (SERVED, "its oracle", {"popl": 79, "oracle": 100}),  # the interval reaches 80
        (PARTLY, "its oracle", {"popl": 70, "oracle": 100}),
        (PARTLY, "its oracle", {"popl": (68, 7), "oracle": 100}),  # it reaches 0.8 from 0.54
        (LOST, "its oracle", {"popl": 36, "oracle": 100}),
        (FEW, "its oracle", {"popl": (70, 20), "oracle": 100}),
        # Both stand still: a recovery of 0.99 says nothing.
        (ORACLE, "its oracle", {"popl": 0.99, "oracle": 1.0}),
        (ORACLE, "the best behaviour", {"popl": 1, "oracle": 1, "best_behaviour": 150, "data": 70}),
        # A recovery of 3.92 by an oracle that is poor.
        (
            ORACLE,
            "the best behaviour",
            {"popl": 24.7, "oracle": 6.1, "best_behaviour": 150, "data": 75},
        ),
        (DATA, "the best behaviour", {"popl": 70, "oracle": 90, "best_behaviour": 150, "data": 75}),
        (DATA, "its oracle", {"popl": 1.0, "oracle": 100}),
        # The oracle is poor, and the set is not.
        (SERVED, "the optimum", {"popl": 90, "oracle": 0, "optimum": (100, 0.0)}),
        # The oracle is poorer than what was cloned without any answer.
        (PARTLY, "the clone of the data", {"popl": 70, "oracle": 60, "clone": 100}),
        (SERVED, "PPO", {"popl": 90, "oracle": 50, "ppo": 100}),
    ],
)
def test_a_word_for_each_group(word, best, returns):
    (verdict,) = verdicts(table(random=0.0, **returns), "popl")
    assert verdict.word == word, str(verdict)
    assert verdict.best.startswith(best)
    assert str(verdict).startswith(f"fast: {word} (")
    assert "nan" not in str(verdict)


def test_intervals_are_those_of_the_share():
    """Share 0.9; errors 1, 0.9 and 0.1 of 100: half-width 1.96 * sqrt(1.82) / 100."""
    (verdict,) = verdicts(table(random=0.0, popl=90.0, oracle=100.0), "popl")
    assert verdict.share == pytest.approx(0.9)
    half = 1.96 * (1 + 0.81 + 0.01) ** 0.5 / 100
    assert (verdict.low, verdict.high) == pytest.approx((0.9 - half, 0.9 + half))


def test_nothing_is_said_without_anything_to_compare_with():
    assert verdicts(table(random=0.0, popl=90.0), "popl") == []
    assert verdicts(table(popl=90.0, oracle=100.0), "popl") == []


def warning(raters, members, *, shares=None, dimensions=1, slips=0.0):
    """What is said of 200 new raters by a set whose members want exactly what some groups do."""
    observation = torch.rand(1000, 1, dimensions, generator=torch.Generator().manual_seed(0))
    segments = TensorDict({"observation": observation}, [1000, 1])
    groups = make_groups(raters, label="return", response=Response(mistake=slips))
    utility = torch.stack([group.segment_utility(segments) for group in groups])
    found = look_for_unexplained(
        20 * utility[members], groups, utility, new_raters=20, shares=shares, pool=None, seed=0
    )
    rows = [("popl", "", "all", measure, value) for measure, value in found.measures().items()]
    rows.append(("popl", "", "all", "gain", 0.3))
    return unexplained(pd.DataFrame(rows, columns=RESULT_COLUMNS)), found


RING = [f"ring({place},6)" for place in range(6)]
SHARES = [0.4, 0.25, 0.15, 0.1, 0.06, 0.04]
BLENDS = [f"blend({place / 40})" for place in range(41)]


@pytest.mark.parametrize("slips", [0.0, 0.2])
def test_a_lost_group_of_four_percent_is_noticed(slips):
    said, met = warning(RING, [0, 1, 2, 3, 4], shares=SHARES, slips=slips)
    assert met.share == pytest.approx(0.04, abs=0.025)
    assert met.accuracy < met.typical - 0.1
    assert "of new raters are explained by no member" in said


@pytest.mark.parametrize("slips", [0.0, 0.2])
def test_nobody_is_called_lost_where_all_are_there_or_wants_are_a_continuum(slips):
    assert warning(RING, list(range(6)), shares=SHARES, slips=slips)[0] is None
    assert warning(BLENDS, [2, 10, 20, 30, 38], dimensions=2, slips=slips)[0] is None
