import pytest
import torch

from popl_rl.calibration import SCALES, fit_scale
from popl_rl.comparisons import Comparisons
from popl_rl.polish import log_likelihood


def answers(raters, each):
    pair = torch.zeros(raters * each, dtype=torch.long)
    case = torch.arange(raters).repeat_interleave(each)
    return Comparisons(pair, pair, case, raters)


def test_modest_margins_of_the_right_member_win_at_a_larger_scale():
    """Each of four answers: the first member passes by 0.1; the second passes three by 1, fails one.

    At scale 1 the other three answers of a passed one speak for the second member by far; from
    0.1 * scale = 1 on, the failed answer counts against it as it should.
    """
    first, second = torch.full((4,), 0.1), torch.tensor([2.0, 2.0, 2.0, -1.0])
    margin = torch.stack([first, second])
    scale = fit_scale(margin, answers(1, 4))
    assert scale > 1

    def predicted(scale):
        likelihood = log_likelihood(scale * margin, 0.05)
        others = likelihood.sum(1, keepdim=True) - likelihood
        return likelihood.gather(0, others.argmax(0, keepdim=True)).mean()

    values = [float(predicted(scale)) for scale in SCALES]
    assert scale == SCALES[max(range(len(SCALES)), key=values.__getitem__)]


@pytest.mark.parametrize("true", [0.25, 2.0, 8.0])
def test_the_scale_that_answers_were_drawn_with_is_found(true):
    generator = torch.Generator().manual_seed(0)
    raters, each = 60, 40
    comparisons = answers(raters, each)
    member = torch.arange(raters) % 2
    worth = torch.randn(2, raters * each, generator=generator)
    chance = torch.sigmoid(true * worth[member[comparisons.case], torch.arange(raters * each)])
    slip = torch.rand(raters * each, generator=generator) < 0.05
    right = (torch.rand(raters * each, generator=generator) < chance) ^ slip
    margin = torch.where(right, worth, -worth)
    assert fit_scale(margin, comparisons) in (true / 2, true, 2 * true)
    assert fit_scale(margin * true, comparisons) in (0.5, 1.0, 2.0)


def test_with_nothing_to_choose_the_scale_stays():
    assert fit_scale(torch.randn(1, 6), answers(2, 3)) == 1.0
    assert fit_scale(torch.randn(3, 6), answers(6, 1)) == 1.0


def test_a_chance_of_slips_that_says_nothing_is_refused():
    with pytest.raises(ValueError, match=r"mistake must be in \[0, 0.5\), got 0.5"):
        fit_scale(torch.randn(2, 6), answers(2, 3), mistake=0.5)
