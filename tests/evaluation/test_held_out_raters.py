import math

import pytest
import torch

from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.held_out_raters import draw_held_out_raters, favourites, gain, met_answers
from popl_rl.models.preference_likelihood import InParts


def panel_of(raters, answers):
    """Comparisons by raters who answer the same number of times; margins are made up."""
    case = torch.arange(raters).repeat_interleave(answers)
    return Comparisons(case * 0, case * 0 + 1, case, raters)


def test_a_panel_is_drawn_in_the_shares_of_the_groups(groups, segments, generator):
    """Groups want the opposite: whoever answers for the first one's utility is of that group."""
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    held_out = draw_held_out_raters(
        groups, segment_utility, raters=40, answers=6, shares=[0.25, 0.75], generator=generator
    )
    assert held_out.batch_size == (240,)
    assert torch.equal(held_out["rater"], torch.arange(40).repeat_interleave(6))
    assert set(held_out.keys(True, True)) == {"pair", "answer", "rater"}, "nobody's group"
    chosen = held_out["pair"].gather(1, held_out["answer"].unsqueeze(1)).squeeze(1)
    other = held_out["pair"].gather(1, 1 - held_out["answer"].unsqueeze(1)).squeeze(1)
    of_first = (segment_utility[0, chosen] > segment_utility[0, other]).view(40, 6)
    assert bool((of_first.all(1) | (~of_first).all(1)).all())
    assert 3 <= int(of_first.all(1).sum()) <= 18


def test_a_favourite_is_the_likeliest_and_not_the_one_with_most_passes():
    """Two answers. Member 0 passes both, hardly: 2 log s(0.1) = -1.29 without slips. Member 1
    passes both clearly. For rater 1 member 0 passes one of two and member 1 none."""
    margin = torch.tensor([[0.1, 0.1, 3.0, -0.1], [4.0, 4.0, -3.0, -3.0]])
    assert favourites(margin, panel_of(2, 2)).tolist() == [1, 0]


def test_the_gain_of_catering_by_hand():
    """Two raters, four answers each, told apart by two members that each pass all of one's.

    Catered by either half: all right. One for all, the pooled one: passes 3 of rater 0's answers
    and 2 of rater 1's, more than a member's 4 of 8. The differences are 1/4 and 1/2: mean 3/8,
    standard deviation 0.25 / sqrt(2), standard error of the mean 0.125.
    """
    margin = torch.tensor([[2.0] * 4 + [-2.0] * 4, [-2.0] * 4 + [2.0] * 4])
    pooled = torch.tensor([1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
    found = gain(margin, pooled, panel_of(2, 4))
    assert found.catered == 1
    assert found.alone == pytest.approx(5 / 8)
    assert found.error == pytest.approx(0.125)
    assert gain(margin, None, panel_of(2, 4)).alone == pytest.approx(1 / 2)


def test_answers_do_not_choose_the_favourite_that_they_judge():
    """One rater, two answers, of which each speaks for another member: the favourite by one is
    wrong about the other."""
    margin = torch.tensor([[2.0, -2.0], [-2.0, 2.0]])
    found = gain(margin, None, panel_of(1, 2))
    assert found.catered == 0
    assert found.alone == 0.5
    assert math.isnan(found.error)


def test_members_that_are_the_same_gain_nothing(generator):
    one = torch.randn(1, 400, generator=generator)
    found = gain(one.expand(5, -1), one[0], panel_of(20, 20))
    assert found.catered == found.alone
    assert found.error == 0


def test_members_that_differ_in_what_nobody_cares_about_gain_nothing(generator):
    """Margins that have nothing to do with who answers."""
    found = gain(torch.randn(6, 4000, generator=generator), None, panel_of(100, 40))
    assert abs(found.catered - found.alone) < 3 * found.error + 0.03


def test_answers_are_met_by_the_favourite_of_the_other_half_in_any_number_of_parts(generator):
    """So many members that 19 answers are looked at together, not all 22."""
    panel = panel_of(2, 11)
    margin = torch.randn(220_000, 22, generator=generator)
    half = torch.arange(22) % 2
    met = torch.zeros(22, dtype=torch.bool)
    for asked in (0, 1):
        chosen_by, judged = (half == asked).nonzero()[:, 0], (half != asked).nonzero()[:, 0]
        favourite = favourites(margin[:, chosen_by], panel.rows(chosen_by))
        met[judged] = margin[favourite[panel.case[judged]], judged] > 0
    parts = InParts(len(margin), lambda part: margin[:, part])
    assert len(list(parts.blocks(panel))) == 2
    expected = met.view(2, 11).float().mean(1)
    assert torch.equal(met_answers(parts, panel), expected)
    assert torch.equal(met_answers(margin, panel), expected)
