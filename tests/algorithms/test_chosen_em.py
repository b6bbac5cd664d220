"""EM that is not told the number of groups: raters held out choose it."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.chosen_em import ChosenEM
from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.models.reward_functions import RewardSpec

SPEC = RewardSpec(1, 1, (32, 32))


def build(bank, comparisons, *, seed=0, steps=400):
    training = Training(steps=steps, batch_size=64, learning_rate=0.02)
    problem = Problem(SPEC, bank, comparisons, training, members=8, generations=20)
    return ChosenEM(problem, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("groups", [1, 2])
def test_it_chooses_about_as_many_components_as_there_are_groups(ring, served, groups):
    bank, comparisons, group = ring(groups, raters=30)
    method = build(bank, comparisons)
    metrics = [method.step() for _ in range(method.generations)]
    found = method.result()
    assert groups <= len(found) <= groups + 1  # of the 12 raters held out, some may like one more
    assert min(served(found, bank, comparisons, group)) > 0.85
    assert len(metrics) == 26  # 0.3 of the generations to choose, then all of them
    assert [size for size, _, _ in method.sizes] == [1, 2, 3, 5, 8]
    assert min(error for _, _, error in method.sizes) == 0  # the best is not behind itself


def test_its_search_never_sees_the_raters_who_choose(ring):
    bank, comparisons, _ = ring(2)
    method = build(bank, comparisons)
    learnt = method.mixtures[0].problem.comparisons.case.unique().tolist()
    judged = method.judged.comparisons.case.unique().tolist()
    assert len(judged) == 5  # of 24
    assert sorted([*learnt, *judged]) == list(range(24))


def test_tables_have_a_column_for_each_member_all_along(ring):
    bank, comparisons, _ = ring(2)
    method = build(bank, comparisons, steps=20)
    sizes = set()
    for _ in range(method.generations):
        sizes.add(len(method.population))
        method.step()
    assert sizes == {8}


def test_it_needs_two_raters(ring):
    bank, comparisons, _ = ring(2)
    alone = replace(comparisons, case=torch.zeros_like(comparisons.case), num_cases=1)
    with pytest.raises(ValueError, match="at least 2 raters"):
        build(bank, alone)
