import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

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


def told_twice(margin, weight):
    """Answers of one rater, each a comparison one way and, by the rest of its weight, the other."""
    weight = torch.tensor(weight)
    count = torch.arange(len(weight))
    said = replace(answers(1, 2 * len(count)), answer=count.repeat(2))
    return torch.cat([margin, -margin], 1), replace(said, weight=torch.cat([weight, 1 - weight]))


def test_soft_labels_count_by_their_weights():
    """Sure by 0.9 of four answers: ``0.9 log sigmoid(m) + 0.1 log sigmoid(-m)`` is best at ln 9.

    Were both halves to count alike, margins would best be nothing, the smallest scale.
    """
    margin, said = told_twice(torch.full((2, 4), math.log(9) / 4), [0.9] * 4)
    assert fit_scale(margin, said, mistake=0.0) == 4.0
    assert fit_response(margin, said, mistake=0.0)[0] == 4.0


@pytest.mark.parametrize("scale", [0.25, 4.0])
def test_the_threshold_of_ties_has_the_scale_of_the_margins(scale):
    """Margins and threshold too small or large alike are put right alike."""
    generator = torch.Generator().manual_seed(0)
    utility = 2 * torch.randn(3000, generator=generator)
    first, second = (utility - 1).sigmoid(), (-utility - 1).sigmoid()
    chance = torch.stack([first, second, 1 - first - second], 1)
    answer = chance.multinomial(1, generator=generator)[:, 0]
    segment = torch.arange(6000).view(2, 3000).T
    rater = torch.arange(3000) % 50
    data = TensorDict({"pair": segment, "answer": answer, "rater": rater}, [3000])
    said = Comparisons.from_preferences(data, cases="rater", ties="rao_kupper")
    score = torch.cat([utility, torch.zeros(3000)]) / scale
    margin = (score[said.preferred] - score[said.other]).repeat(2, 1)
    said = replace(said, threshold=1.0 / scale)
    assert fit_scale(margin, said, mistake=0.0) == scale
    assert scale / 1.5 < fit_response(margin, said, mistake=0.0)[0] < 1.5 * scale
    # At the largest scale exp(2 * 32 * 20) does not fit into a number.
    large = replace(said, threshold=20.0)
    assert fit_scale(margin, large) in SCALES
