"""People who are held out: what is told, what is judged, and what a belief makes of it."""

import math

import pytest
import torch

from popl_rl.algorithms.vpl import VPL
from popl_rl.config import VPLSettings
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.people import Questions, SetPredictor, draw_questions, judge
from popl_rl.evaluation.people_models import EncodedPredictor, IndividualPredictor


def said(*sizes):
    """Comparisons of segments 0 and 1, so many of each person."""
    case = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))
    zero = torch.zeros(len(case), dtype=torch.long)
    return Comparisons(zero, zero + 1, case, len(sizes))


def test_answers_are_either_told_or_judged(generator):
    comparisons = said(8, 3, 30)
    questions = draw_questions(comparisons, [0, 2], most=20, repeats=2, generator=generator)
    assert questions.person.tolist() == [0, 0, 2, 2]
    assert questions.told.tolist() == [6, 6, 20, 20]
    assert questions.mask.sum(1).tolist() == [2, 2, 10, 10]
    for trial in range(4):
        told = questions.asked[trial, : questions.told[trial]].tolist()
        judged = questions.judged[trial, questions.mask[trial]].tolist()
        own = (comparisons.case == questions.person[trial]).nonzero()[:, 0].tolist()
        assert sorted(told + judged) == own
    assert questions.asked[0].tolist() != questions.asked[1].tolist()


def test_many_answers_are_judged_by_at_most_so_many(generator):
    questions = draw_questions(said(100), [0], most=5, most_judged=7, generator=generator)
    assert questions.told.tolist() == [5]
    assert questions.judged.shape == (1, 7)


def test_people_with_one_answer_cannot_judge(generator):
    with pytest.raises(ValueError, match="two answers or more to be judged, got 1 of 2"):
        draw_questions(said(1, 4), [0, 1], generator=generator)


def one_trial(told, judged):
    rows = torch.tensor([told]), torch.tensor([judged])
    mask = torch.ones(1, len(judged), dtype=torch.bool)
    return Questions(torch.tensor([0]), rows[0], torch.tensor([len(told)]), rows[1], mask)


#: Two members of opposite minds: odds of the first against the second after one answer with
#: margins +1 and -1, without slips, are sigmoid(1) / sigmoid(-1) = e.
MARGIN = torch.tensor([[1.0, 1.0, 2.0], [-1.0, -1.0, -2.0]])


def test_beliefs_follow_bayes_by_hand():
    predictor = SetPredictor(MARGIN, mistake=0.0)
    questions = one_trial([0, 1], [2])
    for answers in (0, 1, 2):
        odds = math.exp(answers)
        expected = [odds / (1 + odds), 1 / (1 + odds)]
        assert predictor.belief(questions, answers).exp()[0].tolist() == pytest.approx(expected)


def test_a_mixture_predicts_by_all_members_and_catering_by_one():
    questions = one_trial([0], [2])
    chance, right = SetPredictor(MARGIN, mistake=0.0, mix=True)(questions, 1)
    high = 1 / (1 + math.exp(-2))
    share = math.e / (1 + math.e)
    assert chance.exp().item() == pytest.approx(share * high + (1 - share) * (1 - high))
    assert right.item() == 1
    chance, right = SetPredictor(MARGIN, mistake=0.0)(questions, 1)
    assert (chance.exp().item(), right.item()) == (pytest.approx(high), 1)
    # Before any answer a mixture of opposite minds tosses a coin.
    chance, right = SetPredictor(MARGIN, mistake=0.0, mix=True)(questions, 0)
    assert (chance.exp().item(), right.item()) == (pytest.approx(0.5), 0.5)


def test_a_prior_counts_like_answers():
    prior = torch.tensor([0.0, 3.0])
    questions = one_trial([0, 1], [2])
    assert SetPredictor(MARGIN, log_prior=prior)(questions, 2)[1].item() == 0


def test_means_are_over_trials_and_leave_out_who_has_too_few(generator):
    comparisons = said(8, 40)
    questions = draw_questions(comparisons, [0, 1], most=20, repeats=3, generator=generator)
    margin = torch.ones(1, len(comparisons))
    margin[0, comparisons.case == 1] = -1
    people, accuracy, likely = judge(SetPredictor(margin, mistake=0.0), questions, answers=2)
    assert people.tolist() == [0, 1]
    assert accuracy.tolist() == [1, 0]
    expected = [-math.log1p(math.exp(-1)), -math.log1p(math.exp(1))]
    assert likely.tolist() == pytest.approx(expected)
    assert judge(SetPredictor(margin), questions, answers=20)[0].tolist() == [1]


def test_one_model_per_person_learns_from_that_person_alone(problem, comparisons, generator):
    pooled = problem.initial_population(1, generator=generator)
    questions = draw_questions(comparisons, range(8), most=6, generator=generator)
    predictor = IndividualPredictor(problem, comparisons, pooled, steps=60)
    before = predictor(questions, 0)
    scores = problem.margins(pooled)[0]
    torch.testing.assert_close(predictor.margins(questions, 0), scores[questions.judged])
    after = predictor(questions, 6)
    assert after[0].mean() > before[0].mean()
    # The model of one person does not depend on who else is asked.
    alone = Questions(*(each[2:3] for each in vars(questions).values()))
    torch.testing.assert_close(
        predictor.margins(alone, 0), predictor.margins(questions, 0)[2:3], rtol=1e-4, atol=1e-5
    )


def test_an_encoder_is_told_the_answers_in_any_order(problem, comparisons, generator):
    method = VPL(problem, vpl=VPLSettings(latent=2, answers=4), generator=generator)
    method.step()
    questions = draw_questions(comparisons, range(8), most=6, generator=generator)
    predictor = EncodedPredictor(method, comparisons)
    swapped = questions.asked.clone()
    swapped[:, :3] = questions.asked[:, [2, 0, 1]]
    other = Questions(questions.person, swapped, questions.told, questions.judged, questions.mask)
    one, two = (predictor.margins(each, 3) for each in (questions, other))
    torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(predictor.margins(questions, 0), one)
