"""Numbers of niches are judged by the best division that there is for each."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from popl_rl.algorithms.divisions import divisions, merge, prediction
from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.reward_functions import RewardSpec

SPEC = RewardSpec(1, 1, (8,))


def comparisons_of(case):
    rows = torch.arange(len(case))
    return Comparisons(rows, rows + 1, torch.tensor(case), max(case) + 1)


def test_members_that_rank_alike_are_merged_first():
    """Of equal shares 1/4, the cost of a pair is 1/8 of its squared distance.

    Distances squared are 0.01 (0 and 2), 0.04 (1 and 3) and 2 or so between the two pairs.
    """
    chance = torch.tensor([[0.9, 0.0], [0.0, 0.8], [0.9, 0.1], [0.0, 1.0]])
    four, three, two, one = merge(chance, torch.full((4,), 0.25))
    assert four.tolist() == [0, 1, 2, 3]
    assert three.tolist() == [0, 1, 0, 2]
    assert two.tolist() == [0, 1, 0, 1]
    assert one.tolist() == [0, 0, 0, 0]


def test_members_whom_few_need_are_merged_before_others():
    """Costs: 0.49 * 0.5 * 0.49 / 0.99 = 0.12 of the large ones, 1 * 0.49 * 0.01 / 0.5 = 0.01."""
    chance = torch.tensor([[0.0], [0.7], [-1.0]])
    niches = merge(chance, torch.tensor([0.49, 0.5, 0.01]))
    assert niches[1].tolist() == [0, 1, 0]
    # Of equal shares it is the other way round: 0.49 / 6 < 1 / 6.
    assert merge(chance, torch.full((3,), 1 / 3))[1].tolist() == [0, 0, 1]


@given(members=st.integers(1, 9), seed=st.integers(0, 10**6))
def test_merging_loses_as_little_as_wards_method_does(members, seed):
    """Each step takes the pair whose merging adds least to the weighted squares within niches."""
    generator = torch.Generator().manual_seed(seed)
    chance = torch.rand(members, 5, generator=generator, dtype=torch.float64)
    share = torch.rand(members, generator=generator, dtype=torch.float64) + 0.01
    niches = merge(chance, share)
    assert [int(niche.max()) + 1 for niche in niches] == list(range(members, 0, -1))
    for before, after in itertools.pairwise(niches):
        added = spread(chance, share, after) - spread(chance, share, before)
        pairs = itertools.combinations(range(int(before.max()) + 1), 2)
        others = [
            spread(chance, share, torch.where(before == second, first, before))
            - spread(chance, share, before)
            for first, second in pairs
        ]
        assert added == pytest.approx(min(others), abs=1e-9)


def test_members_that_are_too_sure_are_believed_less():
    """Right in three answers of four of each rater, by margins of 100: as good as a 75 % chance."""
    margin = torch.tensor([[100.0, 100, 100, -100] * 50])
    case = torch.arange(50).repeat_interleave(4).tolist()
    value = prediction(margin, comparisons_of(case))
    best = 0.75 * math.log(0.75) + 0.25 * math.log(0.25)
    assert float(value.mean()) == pytest.approx(best, abs=0.01)


def test_a_smaller_number_is_judged_by_larger_populations_too(ring, learn):
    """Two members know whom they serve, and little more; four have learnt what those want."""
    bank, comparisons, group = ring(2, raters=10)
    problem = Problem(SPEC, bank, comparisons, Training(slip=0.05, conservatism=1.0))
    generator = torch.Generator().manual_seed(0)
    population = problem.initial_population(4, generator=generator)
    # The first two members learn one group's answers, the others the other's.
    weight = torch.nn.functional.one_hot(group[comparisons.case]).T.repeat_interleave(2, 0).float()
    learn(problem, population, weight, steps=25)
    two = population.subset([0, 2])
    learn(problem, population, weight, steps=150)
    share = torch.full((4,), 0.25)
    populations = [(population.subset([0]), torch.ones(1)), (two, share[:2] * 2)]
    found = divisions(problem, problem, [*populations, (population, share)])
    alone, merged, three, four = found
    (_, before) = divisions(problem, problem, populations)
    assert int(three.niche.max()) == 2
    assert merged.niche.tolist() == [0, 0, 1, 1]
    assert four.niche.tolist() == [0, 1, 2, 3]
    assert float(merged.value.mean()) > float(before.value.mean()) + 0.02
    assert float(alone.value.mean()) < float(merged.value.mean()) - 0.1


def test_an_ensemble_speaks_by_what_its_members_serve(ring):
    bank, comparisons, _ = ring(2, raters=4)
    problem = Problem(SPEC, bank, comparisons)
    population = problem.initial_population(3, generator=torch.Generator().manual_seed(0))
    own = problem.margins(population)
    whole = divisions(problem, problem, [(population, torch.tensor([0.5, 0.25, 0.25]))])[-1]
    together = whole._replace(niche=torch.tensor([0, 0, 1]))
    expected = torch.stack([(2 * own[0] + own[1]) / 3, own[2]])
    assert torch.allclose(together.margins(problem), expected, atol=1e-6)


def spread(chance, share, niche):
    """Squared distances of members to the centres of their niches, by their shares."""
    total = 0.0
    for number in niche.unique():
        inside = niche == number
        centre = share[inside] @ chance[inside] / share[inside].sum()
        total += float((share[inside] * (chance[inside] - centre).square().sum(1)).sum())
    return total
