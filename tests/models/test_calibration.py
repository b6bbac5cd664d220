import pytest
import torch

from popl_rl.data.comparisons import Comparisons
from popl_rl.models.calibration import SCALES, fit_response, fit_scale
from popl_rl.models.preference_likelihood import log_likelihood


def answers(raters, each):
    pair = torch.zeros(raters * each, dtype=torch.long)
    case = torch.arange(raters).repeat_interleave(each)
    return Comparisons(pair, pair, case, raters)


def test_modest_margins_of_the_right_member_win_at_a_larger_scale():
    """The first member passes all ten answers of a rater by 0.2, the second eight by 1.

    At scale 1 ten answers are worth 10 log(0.9 sigmoid(0.2) + 0.05) = -6.1 under the first, and
    8 log(0.9 sigmoid(1) + 0.05) + 2 log(0.9 sigmoid(-1) + 0.05) = -5.2 under the second, which is
    given to the rater. At scale 8 they are worth -2.2 and -6.4, and what is given passes them all.
    """
    margin = torch.stack([torch.full((10,), 0.2), torch.tensor([1.0] * 8 + [-1.0] * 2)])
    segment_utility = [log_likelihood(scale * margin, 0.05).sum(1) for scale in (1, 8)]
    torch.testing.assert_close(segment_utility[0], torch.tensor([-6.07, -5.22]), atol=0.01, rtol=0)
    torch.testing.assert_close(segment_utility[1], torch.tensor([-2.25, -6.39]), atol=0.02, rtol=0)
    assert fit_scale(margin, answers(1, 10)) == SCALES[-1]


@pytest.mark.parametrize("true", [1.0, 4.0])
def test_the_scale_that_answers_were_drawn_with_is_found(true):
    generator = torch.Generator().manual_seed(0)
    raters, each = 60, 40
    comparisons = answers(raters, each)
    member = torch.arange(raters) % 2
    segment_utility = torch.randn(2, raters * each, generator=generator)
    chance = torch.sigmoid(
        true * segment_utility[member[comparisons.case], torch.arange(raters * each)]
    )
    slip = torch.rand(raters * each, generator=generator) < 0.05
    right = (torch.rand(raters * each, generator=generator) < chance) ^ slip
    margin = torch.where(right, segment_utility, -segment_utility)
    assert fit_scale(margin, comparisons) in (true / 2, true, 2 * true)
    assert fit_scale(margin * true, comparisons) in (0.5, 1.0, 2.0)


def test_with_nothing_to_choose_the_scale_stays():
    assert fit_scale(torch.randn(1, 6), answers(2, 3)) == 1.0
    assert fit_scale(torch.randn(3, 6), answers(6, 1)) == 1.0


def test_a_chance_of_slips_that_says_nothing_is_refused():
    with pytest.raises(ValueError, match=r"mistake must be in \[0, 0.5\), got 0.5"):
        fit_scale(torch.randn(2, 6), answers(2, 3), mistake=0.5)


def test_raters_who_err_are_believed_as_much_as_they_deserve():
    """Right in four answers of five by margins of 50: scale or slips make that a chance of 0.8."""
    margin = torch.where(torch.arange(200) % 5 == 0, -50.0, 50.0).unsqueeze(0)
    for given in (None, 0.05, 0.2):
        scale, mistake = fit_response(margin, answers(20, 10), mistake=given)
        assert given in (None, mistake)
        chance = log_likelihood(torch.tensor(50 * scale), mistake).exp()
        assert float(chance) == pytest.approx(0.8, abs=0.03)


def test_a_given_chance_of_slips_must_be_one():
    with pytest.raises(ValueError, match=r"mistake must be in \[0, 0.5\), got 0.6"):
        fit_response(torch.randn(2, 6), answers(2, 3), mistake=0.6)
