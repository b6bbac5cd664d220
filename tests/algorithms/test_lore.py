"""Low-rank reward functions."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.cpl import train
from popl_rl.algorithms.lore import LoRe
from popl_rl.algorithms.problem import Problem
from popl_rl.config import LoReSettings, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.people import draw_questions
from popl_rl.evaluation.people_models import MixedPredictor
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import case_values


def build(problem, *, seed=0, **settings):
    generator = torch.Generator().manual_seed(seed)
    return LoRe(problem, lore=LoReSettings(**settings), generator=generator)


@pytest.fixture
def by_hand():
    """Items with two numbers; the two bases are the one and the other, as they are."""
    observation = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    row, action = torch.arange(3).unsqueeze(1), torch.zeros(3, 1, dtype=torch.long)
    comparisons = Comparisons(
        torch.tensor([1, 1, 2, 2]), torch.tensor([0, 2, 0, 1]), torch.tensor([0, 0, 1, 1]), 2
    )
    bank = SegmentBank(observation, row, action, False)
    training = Training(steps=20, batch_size=8, alpha=1.0, slip=0.0, learning_rate=0.05)
    problem = Problem(RewardSpec(2, 1, ()), bank, comparisons, training, generations=4)
    method = build(problem, bases=2, fit_steps=200)
    method.bases.members.data["0", "weight"].copy_(torch.eye(2).unsqueeze(1))
    method.free.data.zero_()
    return method


def test_mixtures_by_hand(by_hand):
    weights = torch.tensor([[1.0, 0.0], [0.25, 0.75]])
    scores = by_hand.problem.scores(by_hand.mixtures(weights))
    assert scores.tolist() == [[0, 4, 0], [0, 1, 3]]


def test_weights_of_new_raters_go_where_their_answers_point(by_hand):
    """One likes the first number, one the second, one says both, and one says nothing."""
    preferred = torch.tensor([[1, 1], [2, 2], [1, 2], [0, 0]])
    other = torch.tensor([[2, 0], [1, 0], [2, 1], [0, 0]])
    there = torch.tensor([[True, True], [True, True], [True, True], [False, False]])
    weights = by_hand.fit(preferred, other, there)
    torch.testing.assert_close(weights.sum(1), torch.ones(4))
    assert weights[0, 0] > 0.95
    assert weights[1, 1] > 0.95
    torch.testing.assert_close(weights[2:], torch.full((2, 2), 0.5))
    # An answer that there is not, says nothing.
    there[0, 1] = False
    other[0, 1] = 2
    one = by_hand.fit(preferred[:1, :1], other[:1, :1], there[:1, :1])
    torch.testing.assert_close(by_hand.fit(preferred, other, there)[0], one[0])


@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize("kind", [PolicySpec(5, 2, True, (6,)), RewardSpec(5, 2, (6,))])
def test_rewards_and_logits_are_mixed(problem, kind, evolve):
    """Linear in the weights: rewards are, and so are differences of logits."""
    method = build(replace(problem, spec=kind, evolve=evolve), bases=3)
    trunk = [value.clone() for value in method.bases.trunk.parameters()]
    method.step()
    moved = not all(map(torch.equal, trunk, method.bases.trunk.parameters()))
    assert moved == (evolve == "all")
    weights = torch.tensor([[0.2, 0.3, 0.5]])
    observation = torch.eye(5)
    mixed = method.mixtures(weights)(observation)
    torch.testing.assert_close(
        mixed[0], (weights[0, :, None, None] * method.bases(observation)).sum(0)
    )


def test_two_groups_are_told_apart(problem):
    training = Training(steps=300, batch_size=64, learning_rate=0.01)
    method = build(replace(problem, training=training, generations=10), bases=2)
    found = train(method)
    values = case_values(problem.margins(found.population) > 0, problem.comparisons)
    one, two = values[:, :4].mean(1), values[:, 4:].mean(1)
    assert one.max() > 0.85
    assert two.max() > 0.85
    assert one.argmax() != two.argmax()
    # Further answers of a person are predicted better once some are told.
    said = problem.comparisons
    questions = draw_questions(said, range(8), most=10, generator=torch.Generator().manual_seed(0))
    predictor = MixedPredictor(method, said)
    before, after = (predictor(questions, told)[1][questions.mask].mean() for told in (0, 10))
    assert after > before + 0.2


def test_what_it_cannot_learn_from_is_refused(problem, comparisons):
    count = len(comparisons)
    alone = Comparisons(comparisons.preferred, comparisons.other, torch.arange(count), count)
    with pytest.raises(ValueError, match="method lore needs rater ids"):
        build(replace(problem, comparisons=alone))
    with pytest.raises(ValueError, match=r"lore\.bases must be at least 1, got 0"):
        build(problem, bases=0)
