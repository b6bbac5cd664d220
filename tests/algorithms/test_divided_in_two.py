"""One niche for everybody is taken only if its raters cannot be divided in two."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.divided_in_two import divided_in_two
from popl_rl.algorithms.divisions import prediction
from popl_rl.algorithms.niche_members import NicheMembers
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.trials import Fold
from popl_rl.config import Training
from popl_rl.data.comparisons import Comparisons
from popl_rl.envs.hidden_utility import sample_states
from popl_rl.models.reward_functions import RewardSpec, reward_bank

RATERS, ANSWERS, GENERATIONS = 90, 32, 20


def world(apart):
    """Raters of two groups that contradict each other on ``2 apart`` of all pairs, and folds."""
    generator = torch.Generator().manual_seed(0)
    states = sample_states(400, generator=generator)
    group = torch.arange(RATERS) % 2
    rater = torch.arange(RATERS).repeat_interleave(ANSWERS)
    pair = torch.randint(400, (len(rater), 2), generator=generator)
    value = states["observation"][:, 0, 0][pair] + apart * group[rater].unsqueeze(1)
    first = (value.remainder(1)[:, 0] > value.remainder(1)[:, 1]).long()
    row = torch.arange(len(rater))
    comparisons = Comparisons(pair[row, 1 - first], pair[row, first], rater, RATERS)
    training = Training(conservatism=1.0, learning_rate=0.02, batch_size=128, steps=300)
    problem = Problem(
        RewardSpec(1, 1, (32, 32)),
        reward_bank(states),
        comparisons,
        training,
        generations=GENERATIONS,
    )

    def only(rows):
        return replace(problem, comparisons=comparisons.rows(rows.nonzero()[:, 0]))

    out = [rater % 3 == fold for fold in range(3)]
    return problem, [Fold(only(~aside), only(aside)) for aside in out], group


def with_one(folds, generator):
    """How one niche for all predicts raters of whom it has not learnt, ``[C]``."""
    value = torch.zeros(RATERS)
    for learnt, judged in folds:
        member = NicheMembers(learnt, torch.ones(1, RATERS), generator=generator)
        for generation in range(GENERATIONS):
            member.step(generation, GENERATIONS)
        value += prediction(judged.margins(member.stack), judged.comparisons)
    return value


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def test_two_groups_that_agree_nearly_everywhere_are_told_apart(generator):
    problem, folds, group = world(apart=0.08)
    one = with_one(folds, generator)
    two = divided_in_two(problem, folds, one, generations=GENERATIONS, generator=generator)
    lead = two.value - one
    assert float(lead.mean()) > 2 * float(lead.std()) / RATERS**0.5
    niche = two.served(problem).argmax(0)
    alike = float((niche == group).float().mean())
    assert max(alike, 1 - alike) > 0.8


def test_one_group_is_not_divided_for_good(generator):
    problem, folds, _ = world(apart=0.0)
    one = with_one(folds, generator)
    two = divided_in_two(problem, folds, one, generations=GENERATIONS, generator=generator)
    assert float((two.value - one).mean()) < 0.002


def test_raters_who_are_predicted_alike_stay_together(generator):
    problem, folds, _ = world(apart=0.08)
    before = generator.get_state()
    alike = torch.full((RATERS,), -0.1)
    assert divided_in_two(problem, folds, alike, generations=2, generator=generator) is None
    assert torch.equal(generator.get_state(), before)
