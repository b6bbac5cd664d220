import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from popl_rl.data.comparisons import Comparisons
from popl_rl.keys import Answer

FIRST, SECOND, TIE, SKIP = (int(answer) for answer in Answer)


def make(pair, answer, **more):
    data = {"pair": torch.tensor(pair), "answer": torch.tensor(answer)}
    more = {key: torch.tensor(value) for key, value in more.items()}
    return TensorDict({**data, **more}, [len(answer)])


@pytest.fixture
def five():
    """Answers of raters 7, 3, 7, 9 and 3; rater 9 only ties."""
    return make(
        [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9]],
        [FIRST, SECOND, SKIP, TIE, FIRST],
        rater=[7, 3, 7, 9, 3],
    )


def test_rater_cases_by_hand(five):
    """Three strict answers: 0 over 1 (rater 7), 3 over 2 and 8 over 9 (rater 3).

    Raters without a strict answer are no case, so cases are 0 for rater 3 and 1 for rater 7.
    """
    comparisons = Comparisons.from_preferences(five, cases="rater")
    assert comparisons.preferred.tolist() == [0, 3, 8]
    assert comparisons.other.tolist() == [1, 2, 9]
    assert comparisons.case.tolist() == [1, 0, 0]
    assert comparisons.num_cases == 2
    assert comparisons.num_dropped == 2
    assert len(comparisons) == 3


def test_preference_cases_by_hand(five):
    del five["rater"]
    comparisons = Comparisons.from_preferences(five, cases="preference")
    assert comparisons.case.tolist() == [0, 1, 2]
    assert comparisons.num_cases == 3


@given(
    st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 9), st.sampled_from(Answer), st.integers(0, 3)),
        min_size=1,
    ).filter(lambda rows: any(answer <= SECOND for *_, answer, _ in rows)),
    st.sampled_from(["rater", "preference"]),
)
@settings(max_examples=40, deadline=None)
def test_it_does_not_matter_which_segment_is_shown_first(rows, cases):
    pair, answer = [row[:2] for row in rows], [int(row[2]) for row in rows]
    swapped = [1 - value if value <= SECOND else value for value in answer]
    rater = [row[3] for row in rows]
    one = Comparisons.from_preferences(make(pair, answer, rater=rater), cases=cases)
    other = Comparisons.from_preferences(
        make([pair[::-1] for pair in pair], swapped, rater=rater), cases=cases
    )
    for name in ("preferred", "other", "case"):
        assert torch.equal(getattr(one, name), getattr(other, name))
    assert one.case.unique().tolist() == list(range(one.num_cases))
    assert len(one) + one.num_dropped == len(rows)


def test_some_rows_and_another_device(five):
    comparisons = Comparisons.from_preferences(five, cases="rater").to("cpu")
    some = comparisons.rows(torch.tensor([2, 0]))
    assert some.preferred.tolist() == [8, 0]
    assert some.other.tolist() == [9, 1]
    assert some.case.tolist() == [0, 1]
    assert some.num_cases == 2
    assert comparisons.num_dropped == 2


def test_unknown_cases_are_refused(five):
    with pytest.raises(ValueError, match="cases must be 'preference' or 'rater', got 'group'"):
        Comparisons.from_preferences(five, cases="group")


def test_ties_and_skips_alone_are_refused():
    message = "preferences must hold a strict answer, got 2 ties and skips; lower the raters'"
    with pytest.raises(ValueError, match=message):
        Comparisons.from_preferences(make([[0, 1], [1, 2]], [TIE, SKIP]), cases="preference")


@pytest.mark.parametrize("said", [[-1, 1], [4, 7], [0.0, 1.0]])
def test_answers_are_positions_in_the_pair(said):
    """Signs and numbers of segments would choose the other group's policy, or end in an index."""
    with pytest.raises(ValueError, match="must be 0 where the first segment of a pair is"):
        Comparisons.from_preferences(make([[4, 7], [7, 4]], said), cases="preference")


def test_rater_cases_need_raters(five):
    del five["rater"]
    message = "preferences must hold 'rater', .* without ids use cases='preference'"
    with pytest.raises(ValueError, match=message):
        Comparisons.from_preferences(five, cases="rater")


def test_ties_and_soft_labels_count_both_ways():
    """Rater 0 says 0.8 for the second, rater 1 a tie: cross-entropies of labels in [0, 1]."""
    preferences = TensorDict(
        {
            "pair": torch.tensor([[0, 1], [2, 3], [4, 5], [6, 7]]),
            "answer": torch.tensor([1, 2, 0, 3]),
            "chance": torch.tensor([0.8, 0.5, 0.0, 0.5]),
            "rater": torch.tensor([0, 1, 1, 1]),
        },
        [4],
    )
    found = Comparisons.from_preferences(preferences, cases="rater", ties="count")
    assert found.preferred.tolist() == [1, 3, 4, 0, 2]
    assert found.other.tolist() == [0, 2, 5, 1, 3]
    assert found.weight.tolist() == pytest.approx([0.8, 0.5, 1, 0.2, 0.5])
    assert found.case.tolist() == [0, 1, 1, 0, 1]
    assert found.answer.tolist() == [0, 1, 2, 0, 1]
    assert found.sizes().tolist() == pytest.approx([1, 2])
    assert found.num_dropped == 1
    value = torch.tensor([10.0, 10, 10, 20, 20])
    assert found.per_answer(value).tolist() == pytest.approx([12, 15, 10, 12, 15])
    dropped = Comparisons.from_preferences(preferences, cases="rater")
    assert dropped.preferred.tolist() == [1, 4]
    assert dropped.weight is None


def test_whoever_is_unknown_is_a_case_alone():
    preferences = TensorDict(
        {
            "pair": torch.tensor([[0, 1]] * 5),
            "answer": torch.tensor([0, 1, 2, 0, 0]),
            "rater": torch.tensor([-1, 3, -1, -1, 3]),
        },
        [5],
    )
    found = Comparisons.from_preferences(preferences, cases="rater")
    assert found.case.tolist() == [1, 0, 2, 0]
    with pytest.raises(
        ValueError, match="ties must be 'drop', 'count' or 'rao_kupper', got 'half'"
    ):
        Comparisons.from_preferences(preferences, cases="rater", ties="half")
