import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.evaluation.ranking_agreement import alike, order_by_agreement, rank_shares

WANTED = np.array([0.0, 1.0, 2.0, 2.0])
NAN = np.nan


@st.composite
def curves(draw, count=4, states=5):
    shape = draw(st.tuples(st.integers(1, count), st.integers(2, states)))
    row = st.lists(st.integers(0, 3), min_size=shape[1], max_size=shape[1])
    return np.array(draw(st.lists(row, min_size=shape[0], max_size=shape[0])), dtype=float)


def test_shares_by_hand():
    members = [[0, 1, 2, 3], [0, 0, 2, 1], [3, 2, 1, 0]]
    found = rank_shares(members, WANTED)
    # The second member ties the first two states, the third ranks all of them backwards.
    expected = [
        [NAN, 1 / 3, 2 / 3, 2 / 3],
        [1 / 3, NAN, 2 / 3, 2 / 3],
        [2 / 3, 2 / 3, NAN, NAN],
        [2 / 3, 2 / 3, NAN, NAN],
    ]
    np.testing.assert_allclose(found, expected)


def test_a_constant_utility_agrees_with_nobody_not_even_with_itself():
    constant = np.full((1, 4), 0.7)
    assert np.nansum(rank_shares(constant, WANTED)) == 0
    members = np.concatenate([constant, WANTED[None]])
    np.testing.assert_array_equal(
        alike(members, {"group": WANTED}), [[1, 0, 1], [0, 0, 0], [1, 0, 5 / 6]]
    )


def test_a_group_that_wants_nothing_is_asked_nothing():
    assert np.isnan(rank_shares(WANTED[None], np.ones(4))).all()
    found = alike(WANTED[None], {"indifferent": np.ones(4), "group": WANTED})
    np.testing.assert_array_equal(found, [[NAN, NAN, NAN], [NAN, 1, 1], [NAN, 1, 5 / 6]])


def test_likeness_by_hand():
    members = [[0, 1, 2, 3], [3, 2, 1, 0], [1, 0, 2, 3]]
    groups = {"up": WANTED, "down": -WANTED, "first": [1, 0, 0, 0]}
    found = alike(members, groups)
    # Five pairs matter to "up" and "down"; "first" cares about the three with state 0.
    expected = [
        [1, 0, 0, 1, 0, 4 / 5],
        [0, 1, 1, 0, 1, 1 / 5],
        [0, 1, 1, 0, 1, 1 / 3],
        [1, 0, 0, 1, 0, 5 / 6],
        [0, 1, 1, 0, 1, 1 / 6],
        [4 / 5, 1 / 5, 1 / 3, 5 / 6, 1 / 6, 1],
    ]
    np.testing.assert_allclose(found, expected)


@settings(max_examples=50, deadline=None)
@given(curves(), st.floats(0.5, 3), st.floats(-1, 1))
def test_scale_and_zero_of_a_utility_do_not_matter(members, scale, zero):
    truth = np.arange(members.shape[1])
    np.testing.assert_array_equal(
        rank_shares(scale * members + zero, truth), rank_shares(members, truth)
    )
    found = alike(members, {"up": truth, "down": -truth})
    np.testing.assert_array_equal(
        alike(scale * members + zero, {"up": truth, "down": -truth}), found
    )
    np.testing.assert_array_equal(found, found.T)
    assert ((found >= 0) & (found <= 1)).all()
    # Ties are nobody's agreement.
    assert (found[0, 2:] + found[1, 2:] <= 1).all()


@settings(max_examples=50, deadline=None)
@given(curves())
def test_the_two_measures_are_one(members):
    truth = np.arange(members.shape[1]) // 2
    if np.isfinite(rank_shares(members, truth)).any():
        mean = alike(members, {"group": truth})[0, 1:].mean()
        assert np.nanmean(rank_shares(members, truth)) == pytest.approx(mean)


def test_like_is_ordered_beside_like():
    generator = np.random.default_rng(0)
    kind = generator.permutation(np.arange(30) % 3)
    likeness = np.where(kind[:, None] == kind, 0.9, 0.2) + generator.uniform(0, 0.05, (30, 30))
    order = order_by_agreement(likeness)
    assert sorted(order) == list(range(30))
    assert np.count_nonzero(np.diff(kind[order])) == 2, "three blocks"


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_hypotheses_are_in_some_order(count):
    assert sorted(order_by_agreement(np.ones((count, count)))) == list(range(count))


@pytest.mark.parametrize(
    ("members", "truth", "message"),
    [
        ([[1.0, 2.0]], [1.0], r"members must have shape \[curves, 1 states\], got \(1, 2\)"),
        ([1.0, 2.0], [1.0, 2.0], r"members must have shape \[curves, 2 states\], got \(2,\)"),
        ([[1.0, NAN]], [1.0, 2.0], "members must be finite, got NaN"),
    ],
)
def test_shapes_are_checked(members, truth, message):
    with pytest.raises(ValueError, match=message):
        rank_shares(members, truth)


def test_shapes_of_truths_are_checked():
    with pytest.raises(
        ValueError, match=r"truths must have shape \[curves, 2 states\], got \(1, 3"
    ):
        alike([[1.0, 2.0]], {"a": [1, 2, 3]})
    with pytest.raises(ValueError, match="members must have shape"):
        alike([1.0, 2.0], {"a": [1, 2]})
