"""Searches that have each found other niches agree upon those that most of them have."""

import math

import pytest
import torch

from popl_rl.algorithms.agreement import agreements
from popl_rl.algorithms.divisions import Division
from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.models.reward_functions import RewardSpec

SPEC = RewardSpec(1, 1, (16,))


@pytest.fixture
def problem(ring):
    """Four groups of six raters each, on a ring: each wants another part of it."""
    bank, comparisons, group = ring(4, raters=6)
    return Problem(SPEC, bank, comparisons, Training(slip=0.05, conservatism=1.0)), group


def held_out(problem, search, searches=3):
    """Answers of every third rater, of whom a search has not learnt."""
    comparisons = problem.comparisons
    rows = (comparisons.case % searches == search).nonzero()[:, 0]
    return Problem(SPEC, problem.bank, comparisons.rows(rows), problem.training)


def knows(learn, problem, group, wants):
    """A division with a trained member for each group of ``wants``; several may want the same."""
    generator = torch.Generator().manual_seed(0)
    population = problem.initial_population(len(wants), generator=generator)
    comparisons = problem.comparisons
    weight = torch.stack([torch.isin(group[comparisons.case], torch.tensor(w)) for w in wants])
    learn(problem, population, weight, steps=150)
    number = len(wants)
    value = torch.zeros(comparisons.num_cases)
    return Division(population, torch.full((number,), 1 / number), torch.arange(number), value)


def divided(learn, problem, group, four):
    """Of one search: divisions into one niche, two, three and four."""
    three = [[0], [1], [2, 3]]
    all_of = [[[0, 1, 2, 3]], [[0, 1], [2, 3]], three, four]
    return [knows(learn, problem, group, wants) for wants in all_of]


def test_a_group_that_one_search_has_lost_is_there(problem, learn):
    """The third has group 0 twice and 2 and 3 together: it says nothing of a niche for 2 alone."""
    problem, group = problem
    right, lost = [[0], [1], [2], [3]], [[0], [0], [1], [2, 3]]
    judged = [held_out(problem, search) for search in range(3)]
    found = agreements(
        problem, judged, [divided(learn, problem, group, f) for f in (right, right, lost)]
    )
    four = found[-1]
    assert (four.number, four.found) == (4, 4)
    served = four.served(problem)
    assert torch.allclose(served.sum(0), torch.ones(24))
    own = torch.stack([served[:, group == g].mean(1) for g in range(4)])
    assert sorted(own.argmax(1).tolist()) == [0, 1, 2, 3]
    assert (own.max(1).values > 0.75).all()
    # All raters are predicted, each by the search that has not learnt of them.
    assert (four.value < 0).all()
    assert float(four.value.mean()) > float(found[1].value.mean()) + 0.05
    assert [len(part.niche.unique()) for part in four.parts] == [4, 4, 3]


def test_what_one_search_alone_has_found_is_dropped(problem, learn):
    problem, group = problem
    two, other = [[0, 1], [2, 3]], [[1, 2], [0, 3]]
    judged = [held_out(problem, search) for search in range(3)]
    own = [[knows(learn, problem, group, wants)] for wants in (two, two, [*two, other[0]])]
    # The third has a niche more, and is cut to as many as the first.
    (found,) = agreements(problem, judged, own)
    assert found.number <= 2
    served = found.served(problem)
    own = torch.stack([served[:, (group > 1) == half].mean(1) for half in (False, True)])
    assert sorted(own.argmax(1).tolist()) == [0, 1]
    assert (own.max(1).values > 0.75).all()


def test_the_scale_is_the_geometric_mean(problem, learn):
    problem, group = problem
    judged = [held_out(problem, search) for search in range(3)]
    own = [divided(learn, problem, group, [[0], [1], [2], [3]]) for _ in range(3)]
    found = agreements(problem, judged, own)[-1]
    each = [
        found._replace(parts=[part]).scale([others])
        for part, others in zip(found.parts, judged, strict=True)
    ]
    assert found.scale(judged) == pytest.approx(math.prod(each) ** (1 / 3))
    assert all(one > 0 for one in each)


def test_one_niche_of_each_search_is_one_niche(problem, learn):
    """Whatever the two rank."""
    problem, group = problem
    judged = [held_out(problem, search, 2) for search in range(2)]
    own = [[knows(learn, problem, group, [[0]])], [knows(learn, problem, group, [[2]])]]
    (found,) = agreements(problem, judged, own)
    assert found.number == 1
    assert [len(part.niche) for part in found.parts] == [1, 1]
