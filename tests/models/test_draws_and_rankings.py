"""Ties under the model of Rao and Kupper (1967), rankings under that of Plackett and Luce."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from popl_rl.algorithms.draws import uniform
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.tie_threshold import with_threshold
from popl_rl.config import Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.calibration import fit_scale
from popl_rl.models.preference_likelihood import (
    answer_likelihood,
    drawn_likelihood,
    fit_threshold,
    leave_one_out,
    per_case,
)
from popl_rl.models.reward_functions import RewardSpec

LN2, LN3 = math.log(2), math.log(3)


def preferences(pair, answer, rater, **more):
    data = {"pair": pair, "answer": answer, "rater": rater, **more}
    return TensorDict({key: torch.tensor(value) for key, value in data.items()}, [len(pair)])


def margins(scores, said):
    score = torch.tensor([scores])
    return score[:, said.preferred] - score[:, said.other]


def tied():
    """One strict answer and one tie, of one rater; the threshold is ln 2."""
    data = preferences([[0, 1], [0, 1]], [0, 2], [0, 0])
    said = Comparisons.from_preferences(data, cases="rater", ties="rao_kupper")
    return replace(said, threshold=LN2)


def ranked():
    """Rater 0 ranks 0 > 1 > 2 (ranking 0), rater 1 prefers 2 to 0."""
    data = preferences(
        [[0, 1], [2, 0], [1, 2], [2, 0]], [0, 1, 0, 0], [0, 0, 0, 1], ranking=[0, 0, 0, -1]
    )
    return Comparisons.from_preferences(data, cases="rater")


def test_the_chances_of_a_draw_are_those_reckoned_by_hand():
    # theta = 2, strengths 3 and 1: 3 / (3 + 2), 1 / (2 * 3 + 1), (4 - 1) * 3 / (5 * 7).
    first, second, tie = 3 / 5, 1 / 7, 9 / 35
    assert first + second + tie == pytest.approx(1)
    said = tied()
    likelihood = answer_likelihood(margins([LN3, 0.0], said), said, 0.0)
    assert said.weight.tolist() == [1.0, 0.5, 0.5]
    assert likelihood[0, 0].exp() == pytest.approx(first)
    assert per_case(likelihood, said).exp() == pytest.approx(first * tie)
    # One answer in ten is a slip: it turns strict answers round, and never ties.
    slipping = answer_likelihood(margins([LN3, 0.0], said), said, 0.1)
    assert slipping[0, 0].exp() == pytest.approx(0.9 * first + 0.1 * second)
    assert slipping[0, 1:].tolist() == likelihood[0, 1:].tolist()


def test_before_anything_is_learnt_the_threshold_explains_the_share_of_ties():
    data = preferences([[0, 1]] * 4, [0, 1, 2, 0], [0] * 4)
    said = Comparisons.from_preferences(data, cases="rater", ties="rao_kupper")
    assert math.tanh(said.threshold / 2) == pytest.approx(1 / 4)
    nothing = torch.zeros(len(said))
    assert fit_threshold(nothing, said, 0.0) == pytest.approx(said.threshold, abs=1e-3)


def test_a_ranking_has_the_chance_of_its_stages():
    said = ranked()
    assert said.weight.tolist() == [0.5, 0.5, 1.0, 1.0]
    likelihood = answer_likelihood(margins([math.log(6), LN3, 0.0], said), said, 0.0)
    # Strengths 6, 3, 1: first of three, then first of two; and 1 against 6.
    assert per_case(likelihood, said)[0].exp().tolist() == pytest.approx([0.6 * 0.75, 1 / 7])
    # A slip names one of the other two, all alike.
    slipping = answer_likelihood(margins([math.log(6), LN3, 0.0], said), said, 0.1)
    assert slipping[0, 0].exp() == pytest.approx(0.9 * 0.6 + 0.1 * 0.4 / 2)


def test_a_ranking_of_nobody_known_is_a_case_and_one_of_two_is_a_comparison():
    data = preferences(
        [[0, 1], [2, 0], [1, 2], [2, 0]], [0, 1, 0, 0], [0] * 4, ranking=[7, 7, 7, 9]
    )
    said = Comparisons.from_preferences(data, cases="preference")
    assert said.case.tolist() == [0, 0, 0, 1]
    margin = margins([0.3, 0.2, 0.9], said)
    single = answer_likelihood(margin, said, 0.05)[0, 3]
    plain = replace(said, stage=None)
    assert single == pytest.approx(float(answer_likelihood(margin, plain, 0.05)[0, 3]))


def test_an_answer_is_left_out_whole():
    said = ranked()
    likelihood = answer_likelihood(margins([1.0, 0.5, 0.0], said), said).repeat(2, 1)
    # Rater 0 has given one answer: nothing is left that would speak for a member.
    assert (said.per_answer(likelihood)[0, :3] == per_case(likelihood, said)[0, 0]).all()
    assert leave_one_out(likelihood, said).shape == (4,)


@pytest.mark.parametrize("make", [tied, ranked])
def test_batches_have_the_gradient_of_the_whole(make):
    said = make()
    features = torch.tensor([[1.0, 0.2], [0.3, -0.5], [-0.4, 0.8]])
    weight = torch.tensor([0.7, -0.4], requires_grad=True)

    def margin(rows):
        score = features @ weight
        return (score[said.preferred[rows]] - score[said.other[rows]]).unsqueeze(0)

    everything = torch.arange(len(said))
    whole = (answer_likelihood(margin(everything), said) * said.weight).sum()
    (wanted,) = torch.autograd.grad(whole, weight)
    # Each comparison alone in a batch, as often as it is drawn.
    drawn = sum(
        said.weight[row] * drawn_likelihood(margin(said.together(row)), said, row).sum()
        for row in everything.unsqueeze(1)
    )
    assert drawn.item() == pytest.approx(whole.item(), abs=1e-6)
    (found,) = torch.autograd.grad(drawn, weight)
    assert found.tolist() == pytest.approx(wanted.tolist(), abs=1e-6)
    assert uniform(said, 2)(5, torch.Generator().manual_seed(0)).shape == (2, 5)


def test_rows_of_a_ranking_keep_together_and_some_of_them_are_one_among_fewer():
    said = ranked()
    again = said.rows(torch.tensor([3, 2, 1, 0]))
    score = [1.0, 0.4, 0.0]
    before = answer_likelihood(margins(score, said), said)
    assert torch.allclose(answer_likelihood(margins(score, again), again), before.flip(1))
    fewer = said.rows(torch.tensor([1]))
    found = answer_likelihood(margins(score, fewer), fewer, 0.0)
    assert found.exp().item() == pytest.approx(1 / (1 + math.exp(-1)))


def test_ties_beside_rankings_are_left_out():
    data = preferences([[0, 1], [0, 2], [1, 2]], [0, 0, 2], [0, 0, 1], ranking=[0, 0, -1])
    said = Comparisons.from_preferences(data, cases="rater", ties="count")
    assert (len(said), said.num_dropped, said.num_cases) == (2, 1, 1)


@pytest.mark.parametrize("answer", [2, 3])
def test_rankings_with_ties_are_refused(answer):
    data = preferences([[0, 1], [0, 2]], [0, answer], [0, 0], ranking=[0, 0])
    with pytest.raises(ValueError, match="rankings must consist of strict answers"):
        Comparisons.from_preferences(data, cases="rater")


def test_the_threshold_that_answered_is_found():
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(60, 3, generator=generator)
    pair = torch.randint(60, (6000, 2), generator=generator)
    pair = pair[pair[:, 0] != pair[:, 1]]
    score = features @ torch.tensor([1.5, -1.0, 0.5])
    margin, threshold = score[pair[:, 0]] - score[pair[:, 1]], 0.8
    first, second = (margin - threshold).sigmoid(), (-margin - threshold).sigmoid()
    chance = torch.stack([first, second, 1 - first - second], 1)
    answer = chance.multinomial(1, generator=generator)[:, 0]
    data = TensorDict(
        {"pair": pair, "answer": answer, "rater": torch.arange(len(pair)) % 50}, [len(pair)]
    )
    said = Comparisons.from_preferences(data, cases="rater", ties="rao_kupper")
    segments = TensorDict(
        {"observation": features.unsqueeze(1), "action": torch.zeros(60, 1, dtype=torch.long)},
        [60, 1],
    )
    training = Training(steps=300, learning_rate=0.05, alpha=1.0, slip=0.0)
    bank = SegmentBank.from_segments(segments)
    problem = Problem(RewardSpec(3, 1, ()), bank, said, training)
    found = with_threshold(problem, generator=generator).comparisons.threshold
    assert found == pytest.approx(threshold, abs=0.08)
    told = with_threshold(problem, threshold=0.3, generator=generator)
    assert told.comparisons.threshold == 0.3


def test_a_ranking_is_of_one_rater():
    data = preferences([[0, 1], [0, 2], [1, 2]], [0, 0, 0], [0, 0, 1], ranking=[1, 1, 1])
    with pytest.raises(ValueError, match=r"must be of one rater, got ranking 1 for several"):
        Comparisons.from_preferences(data, cases="rater")
    # Of several unknown ones each ranking is a case, as each other answer is.
    data = preferences(
        [[0, 1], [0, 2], [1, 2], [2, 0], [1, 0]], [0] * 5, [-1] * 4 + [3], ranking=[5, 5, 5, -1, -1]
    )
    said = Comparisons.from_preferences(data, cases="rater")
    assert (said.case.tolist(), said.num_cases, said.num_answers) == ([1, 1, 1, 2, 0], 3, 3)
    assert said.is_single


def test_where_every_ranking_is_a_case_there_is_no_scale_to_choose():
    data = preferences(
        [[0, 1], [0, 2], [1, 2], [2, 0]], [0, 0, 0, 0], [0] * 4, ranking=[0, 0, 0, 1]
    )
    said = Comparisons.from_preferences(data, cases="preference")
    assert said.is_single
    assert fit_scale(torch.tensor([[0.1, 0.2, 0.1, 0.3], [1.0, -1.0, 1.0, 1.0]]), said) == 1.0
