"""One niche for everybody is taken only if its raters cannot be divided in two."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.divided_in_two import divided_in_two
from popl_rl.algorithms.divisions import prediction
from popl_rl.algorithms.niche_members import train_niches
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.trials import Fold
from popl_rl.config import Training
from popl_rl.models.reward_functions import RewardSpec

RATERS, ANSWERS, GENERATIONS = 90, 32, 20


def world(ring, apart):
    """Raters of two groups that contradict each other on ``2 apart`` of all pairs, and folds."""
    bank, comparisons, group = ring(2, raters=RATERS // 2, answers=ANSWERS, apart=apart)
    training = Training(conservatism=1.0, learning_rate=0.02, batch_size=128, steps=300)
    spec = RewardSpec(1, 1, (32, 32))
    problem = Problem(spec, bank, comparisons, training, generations=GENERATIONS)

    def only(rows):
        return replace(problem, comparisons=comparisons.rows(rows.nonzero()[:, 0]))

    out = [comparisons.case % 3 == fold for fold in range(3)]
    return problem, [Fold(only(~aside), only(aside)) for aside in out], group


def with_one(folds, generator):
    """How one niche for all predicts raters of whom it has not learnt, ``[C]``."""
    value = torch.zeros(RATERS)
    for learnt, judged in folds:
        everybody = torch.ones(1, RATERS)
        member = train_niches(learnt, everybody, generations=GENERATIONS, generator=generator)
        value += prediction(judged.margins(member.stack), judged.comparisons)
    return value


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def test_two_groups_that_agree_nearly_everywhere_are_told_apart(ring, generator):
    problem, folds, group = world(ring, apart=0.08)
    one = with_one(folds, generator)
    two = divided_in_two(problem, folds, one, generations=GENERATIONS, generator=generator)
    lead = two.value - one
    assert float(lead.mean()) > 2 * float(lead.std()) / RATERS**0.5
    niche = two.served(problem).argmax(0)
    alike = float((niche == group).float().mean())
    assert max(alike, 1 - alike) > 0.8


def test_one_group_is_not_divided_for_good(ring, generator):
    problem, folds, _ = world(ring, apart=0.0)
    one = with_one(folds, generator)
    two = divided_in_two(problem, folds, one, generations=GENERATIONS, generator=generator)
    assert float((two.value - one).mean()) < 0.002


def test_raters_who_are_predicted_alike_stay_together(ring, generator):
    problem, folds, _ = world(ring, apart=0.08)
    before = generator.get_state()
    alike = torch.full((RATERS,), -0.1)
    assert divided_in_two(problem, folds, alike, generations=2, generator=generator) is None
    assert torch.equal(generator.get_state(), before)
