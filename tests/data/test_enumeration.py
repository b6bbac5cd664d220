"""States found by trying every action."""

import pytest
import torch

from popl_rl.data.enumeration import Outcome, enumerate_states
from popl_rl.data.tables import policy_return


def walk(place, action):
    """Left or right on a line, over at 3; what is seen there was never tried."""
    after = max(place + (1 if action else -1), 0)
    return Outcome(after, after == 3, float(after == 3), {"place": after, "half": after / 2})


def test_states_are_those_that_can_be_reached_in_the_order_of_a_breadth_first_search():
    found = enumerate_states({1: 3.0, 0: 1.0}, 2, walk)
    assert found.states == [1, 0, 2, 3]
    assert found.start.tolist() == [0.75, 0.25, 0, 0]
    assert found.next_state.tolist() == [[1, 2], [1, 0], [0, 3], [3, 3]]
    assert found.terminal.tolist() == [[False, False], [False, False], [False, True], [True, True]]
    assert found.info["place"].dtype == torch.int64
    assert found.info["half"].tolist()[2] == [0.5, 1.5]


def test_nothing_is_tried_where_an_episode_is_over():
    tried = []

    def step(place, action):
        tried.append(place)
        return walk(place, action)

    enumerate_states({0: 1.0}, 2, step)
    assert sorted(set(tried)) == [0, 1, 2]


def test_a_table_of_them_gives_exact_returns():
    found = enumerate_states({0: 1.0}, 2, walk)
    table = found.table(torch.eye(4), first_action=5)
    assert table.steps["action"][0].tolist() == [5, 6]
    right = torch.tensor([[0.0, 1.0]]).expand(4, 2)
    assert policy_return(table, right, table.steps["reward"], horizon=3) == pytest.approx(1.0)
    assert policy_return(table, right, table.steps["reward"], horizon=2) == 0
    with pytest.raises(ValueError, match=r"must be \[4, features\]"):
        found.table(torch.eye(3))


@pytest.mark.parametrize(
    ("start", "step", "message"),
    [
        ({}, walk, "positive chance to each first state"),
        ({0: 0.0}, walk, "positive chance"),
        ({0: 1.0}, lambda place, action: Outcome(place + action, False), "more than 50 states"),
        ({0: 1.0}, lambda p, action: Outcome(p, True, 0.0, {str(action): 1}), "the same numbers"),
    ],
)
def test_what_is_refused(start, step, message):
    with pytest.raises(ValueError, match=message):
        enumerate_states(start, 2, step, most=50)
