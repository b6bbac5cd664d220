import math
from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.needed import nested_subsets
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.refinement import refine, smallest_subset
from popl_rl.config import RefinementSettings, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import log_likelihood
from popl_rl.models.scoring import segment_scores

QUICK = RefinementSettings(steps=500, most=4)
RECIPE = Training(batch_size=32, learning_rate=0.02, slip=0.0)


def of_cases(case):
    case = torch.tensor(case)
    zero = torch.zeros_like(case)
    return Comparisons(zero, zero, case, int(case.max()) + 1)


def test_log_likelihood_by_hand():
    """sigmoid(ln 3) = 3/4, so with one slip in ten 0.9 * 3/4 + 0.1 * 1/4 = 0.7."""
    margin = torch.tensor([math.log(3), -math.log(3), -1000.0])
    found = log_likelihood(margin, 0.1)
    expected = torch.tensor([0.7, 0.3, 0.1]).log()
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(log_likelihood(margin[:2], 0.0), torch.tensor([0.75, 0.25]).log())


@pytest.mark.parametrize("mistake", [-0.1, 0.5])
def test_a_chance_of_slips_that_says_nothing_is_refused(mistake):
    with pytest.raises(ValueError, match=r"mistake must be in \[0, 0.5\), got"):
        log_likelihood(torch.zeros(1), mistake)


def test_predictive_by_hand():
    """Each answer is judged by the member that explains the rater's other answers best.

    Rater 0: without answer 0 member 1 is ahead (-1 against -2), so answer 0 is worth -5, and
    without answer 1 member 0 is ahead (-1 against -5): -2. Rater 1 is always member 0's.
    """
    likelihood = torch.tensor([[-1.0, -2.0, -1.0, -2.0], [-5.0, -1.0, -3.0, -4.0]])
    found = nested_subsets(likelihood, of_cases([0, 0, 1, 1])).value[-1]
    torch.testing.assert_close(found, torch.tensor([-3.5, -1.5]))


def test_a_member_has_to_earn_its_place():
    """Members 0 and 1 are alike and serve half of the raters, member 2 the other half."""
    noise = torch.randn(2, 80, generator=torch.Generator().manual_seed(0)) * 0.01
    first = torch.cat([torch.full((40,), -0.1), torch.full((40,), -3.0)])
    likelihood = torch.stack([first + noise[0], first + noise[1], first.flip(0)])
    team = smallest_subset(likelihood, of_cases([i // 4 for i in range(80)]))
    assert len(team) == 2
    assert 2 in team


def test_one_that_serves_everybody_is_enough():
    likelihood = torch.tensor([[-1.0] * 8, [-0.5] * 8, [-2.0] * 8])
    assert smallest_subset(likelihood, of_cases([0, 0, 1, 1, 2, 2, 3, 3])) == [1]


def test_no_more_than_asked_for():
    likelihood = torch.full((6, 6), -3.0).fill_diagonal_(-0.1).repeat_interleave(2, 1)
    comparisons = of_cases([i // 2 for i in range(12)])
    assert len(smallest_subset(likelihood, comparisons, most=3)) <= 3
    assert len(smallest_subset(likelihood, comparisons)) == 6


def two_tastes():
    """One observation, segments of one step; half of the raters want action 0, half action 1.

    One answer in ten is a slip: without any noise a rule of standard errors has nothing to go by.
    """
    bank = SegmentBank(
        torch.ones(1, 1), torch.zeros(2, 1, dtype=torch.long), torch.tensor([[0], [1]]), True
    )
    case = torch.arange(32).repeat_interleave(8)
    slips = torch.rand(len(case), generator=torch.Generator().manual_seed(1)) < 0.1
    said = (case + slips) % 2
    population = Population.create(
        PolicySpec(1, 2, True, ()), 6, generator=torch.Generator().manual_seed(0)
    )
    lean = torch.tensor([0.5, 0.4, 0.3, -0.3, -0.4, -0.5])
    population.members.data["0", "weight"].zero_()
    population.members.data["0", "bias"].copy_(torch.stack([lean, -lean], 1))
    return population, bank, Comparisons(said, 1 - said, case, 32)


def refined(seed=0):
    population, bank, comparisons = two_tastes()
    generator = torch.Generator().manual_seed(seed)
    problem = Problem(population.spec, bank, comparisons, RECIPE)
    found = refine(problem, population, settings=QUICK, generator=generator)
    return found, bank


def test_two_tastes_get_one_sharp_member_each():
    found, bank = refined()
    assert len(found) == 2
    scores = segment_scores(found, bank).exp()
    assert scores.argmax(1).sort().values.tolist() == [0, 1]
    assert (scores.amax(1) > 0.9).all()


def test_the_population_is_left_as_it_was():
    population, bank, comparisons = two_tastes()
    before = population.members.data.clone()
    problem = Problem(population.spec, bank, comparisons, RECIPE)
    refine(problem, population, settings=QUICK, generator=torch.Generator())
    assert (before == population.members.data).all()


def test_the_same_seed_gives_the_same_bits():
    one, other = (refined(seed=3)[0].members.data for _ in range(2))
    another = refined(seed=4)[0].members.data
    assert (one == other).all()
    assert not (one == another).all()


def test_cloning_weighs_what_is_asked_beside_what_a_member_serves(monkeypatch):
    """A third of the answers is left out of each copy but the last."""
    population, bank, comparisons = two_tastes()
    known = []
    losses = CPLLoss.answers

    def watched(self, *arguments):
        known.append(self.num_answers.clone())
        return losses(self, *arguments)

    monkeypatch.setattr(CPLLoss, "answers", watched)
    problem = Problem(population.spec, bank, comparisons, replace(RECIPE, bc=2.0))
    settings = RefinementSettings(steps=30, most=2, folds=3)
    found = refine(problem, population, settings=settings, generator=torch.Generator())
    served = known[-1].view(4, len(found)).sum(1)
    assert served[:3].sum() == pytest.approx(2 * len(comparisons), rel=1e-4)
    assert served[3] == pytest.approx(len(comparisons), rel=1e-4)
