"""The checks of rater functions, and the raters of the tiny environment."""

import pytest
import torch

from popl_rl.data.tables import policy_return
from popl_rl.raters.groups import make_groups
from popl_rl.testing import check_rater, likes_left, likes_right, tiny_env


def test_tiny_raters_by_hand():
    table = tiny_env().transition_table()
    left, right = make_groups([likes_left, likes_right], table=table)
    assert left.step_utility(table.steps)[1].tolist() == [1.0, 0.5]
    assert right.step_utility(table.steps)[1].tolist() == [0.0, 0.5]
    assert left.advantages.argmax(1).tolist() == [0] * 5
    assert right.advantages.argmax(1).tolist() == [1] * 5
    # From cells 0 to 4 two steps left are worth 2, 2, 7/4, 5/4 and 3/4.
    go_left = torch.eye(2)[left.advantages.argmax(1)]
    value = policy_return(table, go_left, left.step_utility(table.steps), horizon=2)
    assert value == pytest.approx((2 + 2 + 1.75 + 1.25 + 0.75) / 5)


class Fickle:
    __name__ = "fickle"
    calls = 0

    def __call__(self, segments):
        self.calls += 1
        return likes_left(segments) + self.calls


def modifies(segments):
    segments["observation"].mul_(0)
    return likes_left(segments)


def adds_a_key(segments):
    segments["seen"] = segments["reward"]
    return likes_left(segments)


def normalises(segments):
    utility = likes_left(segments)
    return utility - utility.mean()


def squeezes(segments):
    return likes_left(segments).squeeze()


def only_discrete(segments):
    return segments["observation"]


BROKEN_RATERS = [
    (modifies, ValueError, "'modifies' must leave segments as they are.*work on a copy"),
    (adds_a_key, ValueError, "must leave segments as they are"),
    (Fickle(), ValueError, "'fickle' must give the same utility each time"),
    (normalises, ValueError, "must judge each segment by itself.*do not normalise"),
    (squeezes, ValueError, r"'squeezes' must return one utility per step, shape \[1, 5\]"),
    (only_discrete, ValueError, "reduce the last dimension"),
    (lambda s: s["action"], TypeError, "must return floats"),
    (lambda s: s["reward"] / 0, ValueError, "finite"),
    (lambda s: s["speed"], ValueError, "KeyError"),
    (lambda _: 3.0, TypeError, "got a float"),
]


@pytest.mark.parametrize(("rater", "error", "message"), BROKEN_RATERS)
def test_each_fault_of_a_rater_is_found(rater, error, message):
    with pytest.raises(error, match=message):
        check_rater(rater)


def test_a_utility_of_the_whole_segment_is_warned_of():
    def smooth(segments):
        return likes_left(segments).cumsum(1)

    with pytest.warns(UserWarning, match="'smooth' gives a step another utility alone"):
        check_rater(smooth)


def test_a_rater_can_be_given_in_two_ways():
    check_rater(likes_left)
    check_rater("popl_rl.testing:likes_right", tiny_env, max_steps=1)
    check_rater("third", "two_doors", doors=3)
