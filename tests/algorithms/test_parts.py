"""Comparisons that are looked at some at a time give what all at once give."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.needed import nested_subsets
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.refinement import refine
from popl_rl.config import RefinementSettings, Training
from popl_rl.models.calibration import fit_response, fit_scale
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import leave_one_out, per_case
from popl_rl.models.reward_functions import RewardSpec

MEMBERS = 5


@pytest.fixture
def problem(ring):
    bank, comparisons, _ = ring(2)
    weight = torch.rand(len(comparisons), generator=torch.Generator().manual_seed(3)) + 0.1
    spec = RewardSpec(bank.observation.shape[1], 1, (8,))
    weighted = replace(comparisons, weight=weight)
    return Problem(spec, bank, weighted, clone=None, training=Training(batch_size=16))


@pytest.fixture
def population(problem):
    population = Population.create(
        problem.spec, MEMBERS - 1, generator=torch.Generator().manual_seed(0)
    )
    return population.subset([0, 1, 2, 0, 3])  # two of them alike


def everything(problem, population):
    """Whatever looks at every comparison under every member."""
    comparisons = problem.comparisons
    likelihood = problem.likelihood_in_parts(problem.scores(population))
    margin = problem.margins(population)
    found = problem.hypothesis_set(population)
    distinct = found.distinct(problem.bank, comparisons)
    refined = refine(
        problem,
        population,
        settings=RefinementSettings(steps=8, folds=3, most=3),
        generator=torch.Generator().manual_seed(1),
    )
    nested = nested_subsets(likelihood, comparisons)
    return {
        "likelihood": torch.cat([some for _, some in likelihood.blocks(comparisons)], 1),
        "per_case": per_case(likelihood, comparisons),
        "leave_one_out": leave_one_out(likelihood, comparisons),
        "order": torch.tensor(nested.order),
        "value": nested.value,
        "scale": torch.tensor([fit_scale(margin, comparisons), *fit_response(margin, comparisons)]),
        "distinct": torch.tensor(distinct.origin),
        "effective": torch.tensor(found.effective_number(problem.bank, comparisons)),
        "fair": torch.tensor(found.fair_among(problem.bank, comparisons)),
        **{str(name): value for name, value in refined.members.data.items(True, True)},
    }


@pytest.mark.parametrize("size", [1, 7, 100])
def test_some_at_a_time_are_all_at_once(problem, population, monkeypatch, size):
    whole = everything(problem, population)
    assert 1 < len(whole["distinct"]) < MEMBERS
    monkeypatch.setattr("popl_rl.data.comparisons._NUMBERS", size * MEMBERS)
    assert len(list(problem.comparisons.answer_blocks(MEMBERS))) > 1
    parts = everything(problem, population)
    assert whole.keys() == parts.keys()
    for name, value in whole.items():
        # Torch rounds the last few numbers of a tensor otherwise than those before.
        torch.testing.assert_close(parts[name], value, rtol=1e-4, atol=1e-5)


def test_comparisons_of_one_answer_stay_together(problem, monkeypatch):
    monkeypatch.setattr("popl_rl.data.comparisons._NUMBERS", 1)
    comparisons = problem.comparisons
    halves = replace(comparisons, answer=torch.arange(len(comparisons)) // 2)
    assert list(halves.answer_blocks(1)) == [slice(0, len(comparisons))]
    assert len(list(comparisons.answer_blocks(1))) == len(comparisons)
