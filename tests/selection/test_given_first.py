"""Lexicase selection in orders of which the first case is given."""

from itertools import permutations

import pytest
import torch
from scipy.stats import chisquare

from popl_rl.selection.lexicase import lexicase_given_first, lexicase_selection


def enumerated(scores, first, epsilon):
    """Chance of each member, over all orders that begin with ``first``."""
    members, cases = scores.shape
    chance = torch.zeros(members, dtype=torch.float64)
    orders = [o for o in permutations(range(cases)) if o[0] == first]
    for order in orders:
        pool = list(range(members))
        for case in order:
            best = max(float(scores[m, case]) for m in pool)
            pool = [m for m in pool if float(scores[m, case]) >= best - float(epsilon[case])]
        chance[pool] += 1 / len(pool) / len(orders)
    return chance


SCORES = torch.tensor(
    [[1.0, 0.0, 0.5, 0.2], [0.8, 0.9, 0.1, 0.2], [0.3, 1.0, 0.6, 0.0], [0.9, 0.5, 0.5, 1.0]]
)


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("epsilon", [torch.zeros(4), torch.tensor([0.15, 0.12, 0.25, 0.55])])
def test_parents_have_the_enumerated_chances(first, epsilon, generator):
    chance = enumerated(SCORES, first, epsilon)
    begin = torch.full((2000,), first)
    parents = lexicase_given_first(SCORES, begin, epsilon=epsilon, generator=generator).parents
    counts = parents.bincount(minlength=4)
    assert not counts[chance == 0].any()
    possible = chance > 0
    if possible.sum() > 1:
        assert chisquare(counts[possible], 2000 * chance[possible]).pvalue > 1e-4


def test_uniform_first_cases_make_plain_selection(generator):
    begin = torch.randint(4, (4000,), generator=generator)
    given = lexicase_given_first(SCORES, begin, generator=generator).parents.bincount(minlength=4)
    chance = sum(enumerated(SCORES, first, torch.zeros(4)) for first in range(4)) / 4
    possible = chance > 0
    assert chisquare(given[possible], 4000 * chance[possible]).pvalue > 1e-4
    plain = lexicase_selection(SCORES, 4000, generator=generator).bincount(minlength=4)
    assert not plain[~possible].any()


def test_passes_and_reports(generator):
    passes = torch.tensor([[True, True, False], [False, False, True], [False, False, False]])
    report = lexicase_given_first(passes, torch.tensor([0, 2, 1, 2]), generator=generator)
    assert report.parents.tolist() == [0, 1, 0, 1]
    assert report.depth.tolist() == [1, 1, 1, 1]
    assert report.distinct == 3
    assert report.effective == pytest.approx(2.0)


@pytest.mark.parametrize("first", [[3], [-1], []])
def test_first_cases_must_exist(first, generator):
    passes = torch.ones(2, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"first must hold cases in 0\.\.2"):
        lexicase_given_first(passes, torch.tensor(first).long(), generator=generator)


@pytest.mark.parametrize("first", range(3))
def test_passes_have_the_enumerated_chances(first, generator):
    """The case in the middle, on which all agree, removes nobody and still has its place."""
    passes = torch.tensor(
        [[1, 1, 0, 1], [0, 1, 1, 0], [1, 1, 1, 0], [0, 1, 0, 1], [1, 1, 0, 1]], dtype=torch.bool
    )
    found = lexicase_given_first(passes, torch.full((4000,), first), generator=generator)
    chance = enumerated(passes.float(), first, torch.zeros(4))
    counts = found.parents.bincount(minlength=5)
    assert not counts[chance == 0].any()
    possible = chance > 0
    if possible.sum() > 1:
        assert chisquare(counts[possible], 4000 * chance[possible]).pvalue > 1e-4
    if first == 1:
        assert found.depth.min() >= 2
