"""Which members a set needs."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from popl_rl.algorithms.needed import nested_subsets, predicted, sufficient
from popl_rl.data.comparisons import Comparisons


def of_raters(case):
    row = torch.arange(len(case))
    return Comparisons(row, row + len(case), torch.tensor(case), max(case) + 1)


def test_two_raters_by_hand():
    """Member 0 suits rater 0, member 1 rater 1, member 2 both a little.

    Alone, 2 has a mean of -1, the others (-0.1 - 3) / 2 = -1.55. Beside it, each answer of rater 0
    is predicted by member 0, which the other answer speaks for: (-0.1 - 1) / 2 = -0.55; with all
    three -0.1.
    """
    likelihood = torch.tensor(
        [[-0.1, -0.1, -3.0, -3.0], [-3.0, -3.0, -0.1, -0.1], [-1.0, -1.0, -1.0, -1.0]]
    )
    nested = nested_subsets(likelihood, of_raters([0, 0, 1, 1]))
    assert nested.order == [2, 0, 1]
    expected = torch.tensor([[-1.0, -1.0], [-0.1, -1.0], [-0.1, -0.1]])
    torch.testing.assert_close(nested.value, expected)


def test_an_answer_does_not_choose_the_member_that_predicts_it():
    """Each member is sure of one answer; the other answer chooses the wrong one every time."""
    likelihood = torch.tensor([[-0.1, -5.0], [-5.0, -0.1]])
    nested = nested_subsets(likelihood, of_raters([0, 0]))
    torch.testing.assert_close(nested.value, torch.tensor([[-2.55], [-5.0]]))


def test_a_set_is_judged_by_answers_that_did_not_choose():
    """Rater 0's answers choose members 0 and 1 for each other; rater 2 has none."""
    likelihood = torch.tensor([[-0.1, -5.0, -0.2], [-5.0, -0.3, -0.1]])
    value = predicted(likelihood, of_raters([0, 0, 1]))
    assert value.tolist() == pytest.approx([-5.0, -0.2])


def test_the_smallest_that_is_hardly_behind():
    """One set is behind by 1 and 3: mean 2, deviation 1, error 1 / sqrt(2), so 2.83 errors."""
    behind = torch.tensor([[1.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    assert sufficient(behind, evidence=2.8) == 1
    assert sufficient(behind, evidence=2.9) == 0


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 4), st.integers(0, 99))
def test_every_member_enters_once_and_order_does_not_matter(members, raters, answers, seed):
    generator = torch.Generator().manual_seed(seed)
    case = torch.arange(raters).repeat_interleave(answers).tolist()
    likelihood = -torch.rand(members, len(case), generator=generator, dtype=torch.float64)
    nested = nested_subsets(likelihood, of_raters(case))
    assert sorted(nested.order) == list(range(members))
    # Where a rater's other answers, if there are any, speak for two alike, the first one predicts.
    whole = predicted(likelihood[nested.order], of_raters(case))
    torch.testing.assert_close(nested.value[-1], whole)
    turned = nested_subsets(likelihood.flip(0), of_raters(case))
    torch.testing.assert_close(turned.value[0].mean(), nested.value[0].mean())


def test_a_rater_without_answers_counts_as_nothing():
    comparisons = Comparisons(torch.tensor([0]), torch.tensor([1]), torch.tensor([1]), 2)
    nested = nested_subsets(torch.tensor([[-0.5]]), comparisons)
    assert nested.value.tolist() == [[pytest.approx(0.0), pytest.approx(-0.5)]]
