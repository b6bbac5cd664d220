from itertools import permutations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.raters.condorcet import find_cycle, majority_preference

# Three people who rank a, b, c in turn: abc, bca, cab.
PARADOX = torch.tensor([[3.0, 2.0, 1.0], [1.0, 3.0, 2.0], [2.0, 1.0, 3.0]])


@st.composite
def worths(draw, groups=4, things=6):
    shape = draw(st.tuples(st.integers(1, groups), st.integers(1, things)))
    numbers = st.integers(0, 4)
    row = st.lists(numbers, min_size=shape[1], max_size=shape[1])
    return torch.tensor(draw(st.lists(row, min_size=shape[0], max_size=shape[0]))).float()


def is_cycle(preferred, found, threshold=0.5):
    a, b, c = found
    beats = preferred > threshold + 1e-9
    return bool(beats[a, b] & beats[b, c] & beats[c, a])


def test_majority_by_hand():
    preferred = majority_preference(
        torch.tensor([[1.0, 2.0, 2.0], [3.0, 1.0, 2.0]]), shares=[0.75, 0.25]
    )
    expected = [[0.5, 0.25, 0.25], [0.75, 0.5, 0.375], [0.75, 0.625, 0.5]]
    assert preferred.tolist() == expected
    assert preferred.dtype == torch.float64


def test_shares_are_equal_unless_given():
    assert torch.equal(
        majority_preference(PARADOX), majority_preference(PARADOX, shares=[1 / 3] * 3)
    )
    assert torch.equal(
        majority_preference(PARADOX), majority_preference(PARADOX, shares=torch.ones(3) / 3)
    )


def test_worths_that_differ_by_rounding_are_the_same():
    assert majority_preference(torch.tensor([[1.0, 1.0 + 1e-7]])).tolist() == [
        [0.5, 0.5],
        [0.5, 0.5],
    ]


@settings(max_examples=60, deadline=None)
@given(worths(), st.data())
def test_what_some_prefer_the_others_do_not(segment_utility, data):
    preferred = majority_preference(segment_utility)
    torch.testing.assert_close(preferred + preferred.T, torch.ones_like(preferred))
    order = torch.tensor(data.draw(st.permutations(range(segment_utility.shape[1]))))
    assert torch.equal(majority_preference(segment_utility[:, order]), preferred[order][:, order])
    torch.testing.assert_close(majority_preference(segment_utility.flip(0)), preferred)
    torch.testing.assert_close(majority_preference(-segment_utility), preferred.T)


def test_the_paradox_by_hand():
    """Two of three prefer a to b, b to c, and c to a."""
    preferred = majority_preference(PARADOX)
    assert preferred[[0, 1, 2], [1, 2, 0]].tolist() == pytest.approx([2 / 3] * 3)
    assert find_cycle(preferred) == [0, 1, 2]
    assert find_cycle(preferred.T) == [0, 2, 1]
    assert find_cycle(preferred, threshold=0.7) is None


def test_the_raters_of_a_circle_agree_each_with_himself_and_never_together():
    states = torch.tensor([0.1, 0.45, 0.8])
    segment_utility = torch.stack([(states + thirds / 3) % 1 for thirds in range(3)])
    # 0.1 beats 0.8, which beats 0.45, which beats 0.1.
    assert find_cycle(majority_preference(segment_utility)) == [0, 2, 1]
    for own in segment_utility:
        assert find_cycle(majority_preference(own[None])) is None
    assert find_cycle(majority_preference(segment_utility, shares=[0.6, 0.2, 0.2])) is None


def test_a_draw_is_no_majority():
    """Two opposite groups of 0.3 + 0.2 and 0.5, whose sum in floating point is not 0.5 sharp."""
    segment_utility = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [3.0, 2.0, 1.0]])
    assert find_cycle(majority_preference(segment_utility, shares=[0.3, 0.2, 0.5])) is None


def test_the_widest_majorities_are_chosen():
    preferred = torch.full((6, 6), 0.5)
    for cycle, share in ([(0, 1, 2), 0.6], [(3, 5, 4), 0.9]):
        for one, other in zip(cycle, (*cycle[1:], cycle[0]), strict=True):
            preferred[one, other], preferred[other, one] = share, 1 - share
    assert find_cycle(preferred) == [3, 5, 4]
    preferred[5, 4] = 0.55
    assert find_cycle(preferred) == [0, 1, 2]


def test_of_many_circles_the_one_in_the_middle_is_chosen():
    states = torch.linspace(0.005, 0.995, 100)
    segment_utility = torch.stack([(states + thirds / 3) % 1 for thirds in range(3)])
    found = find_cycle(majority_preference(segment_utility))
    assert found is not None
    assert sorted(states[found].tolist()) == pytest.approx([1 / 6, 1 / 2, 5 / 6], abs=0.02)


@settings(max_examples=60, deadline=None)
@given(worths())
def test_a_circle_is_found_exactly_if_there_is_one(segment_utility):
    preferred = majority_preference(segment_utility)
    found = find_cycle(preferred)
    exists = any(is_cycle(preferred, c) for c in permutations(range(segment_utility.shape[1]), 3))
    assert (found is not None) == exists
    if found is not None:
        assert is_cycle(preferred, found)
        assert found[0] == min(found)
    if len(segment_utility) == 1:
        assert found is None, "one person's worths are in order"


@pytest.mark.parametrize("things", [1, 2])
def test_fewer_than_three_things_go_round_in_no_circle(things):
    assert find_cycle(majority_preference(torch.rand(3, things))) is None


@pytest.mark.parametrize(
    ("segment_utility", "shares", "message"),
    [
        (
            torch.ones(3),
            None,
            r"segment_utility must be finite, of shape \[groups, things\].*shape \[3\]",
        ),
        (torch.ones(0, 2), None, "at least one group"),
        (torch.tensor([[1.0, torch.nan]]), None, "with 1 NaN or infinite"),
        (torch.ones(2, 2), [1.0], "shares must be 2 non-negative numbers, one per group.*got"),
        (torch.ones(2, 2), [0.5, 0.6], "that sum to 1"),
        (torch.ones(2, 2), [1.5, -0.5], "non-negative"),
        (torch.ones(2, 2), [torch.nan, 0.5], "non-negative"),
    ],
)
def test_bad_worths_and_shares(segment_utility, shares, message):
    with pytest.raises(ValueError, match=message):
        majority_preference(segment_utility, shares=shares)


@pytest.mark.parametrize(
    ("preferred", "threshold", "message"),
    [
        (torch.ones(2, 3), 0.5, r"preferred must have shape \[N, N\], got \[2, 3\]"),
        (torch.full((2, 2), torch.nan), 0.5, "preferred must be finite"),
        (torch.ones(2, 2), 0.4, "threshold must be at least 0.5, a majority, got 0.4"),
        (torch.ones(2, 2), torch.nan, "threshold must be at least 0.5"),
    ],
)
def test_bad_majorities(preferred, threshold, message):
    with pytest.raises(ValueError, match=message):
        find_cycle(preferred, threshold=threshold)
