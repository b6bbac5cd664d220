"""Several CPL policies on everybody's answers."""

import math

import pytest
import torch

from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.reward_set import RewardSet

SPEC = PolicySpec(5, 2, True, (6,))


def build(bank, comparisons, *, seed=0, spec=SPEC, members=3, generations=4, **recipe):
    training = Training(**{"steps": 5 * generations, "batch_size": 16, **recipe})
    problem = Problem(spec, bank, comparisons, training, members=members, generations=generations)
    return MultiCPL(problem, generator=torch.Generator().manual_seed(seed))


def parameters_of(popl):
    return [value.clone() for value in popl.population.members.data.values(True, True)]


def test_members_differ_by_chance_and_every_one_learns(bank, comparisons):
    popl = build(bank, comparisons)
    assert isinstance(popl, MultiCPL)
    before = parameters_of(popl)
    metrics = popl.step()
    assert set(metrics) == {"worst_rater_accuracy", "mean_accuracy", "loss_cpl"}
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    for old, new in zip(before, parameters_of(popl), strict=True):
        for member in range(3):
            assert not torch.equal(old[member], new[member])
        assert not torch.equal(new[0], new[1])


def test_what_it_reports_is_what_it_found_by_hand(monkeypatch, bank, comparisons):
    """Two raters of two answers each; members pass 3 of 4 and 1 of 4.

    The best member for the first rater passes both answers, for the second one of two: the 10 %
    quantile of (1, 1/2) is 0.55.
    """
    row = torch.arange(4)
    four = type(comparisons)(row, row + 4, torch.tensor([0, 0, 1, 1]), 2)
    popl = build(bank, four, members=2)
    margin = torch.tensor([[1.0, 2.0, 1.0, -1.0], [-1.0, 0.0, 1.0, -1.0]])
    scores = torch.cat([margin, torch.zeros_like(margin)], 1)
    monkeypatch.setattr(Problem, "compared_scores", lambda *_: scores)
    metrics = popl.step()
    assert metrics["worst_rater_accuracy"] == pytest.approx(0.55)
    assert metrics["mean_accuracy"] == 0.5


def test_pooled_policies_are_better_than_chance_for_everybody_together(bank, comparisons):
    """Left and right want opposite things, so that pooled policies are at best right by half."""
    popl = build(bank, comparisons, generations=8, steps=120, learning_rate=0.02)
    metrics = [popl.step() for _ in range(8)]
    assert metrics[-1]["loss_cpl"] < metrics[0]["loss_cpl"]
    one_group = comparisons.rows(comparisons.case < 4)
    alone = build(bank, one_group, generations=8, steps=120, learning_rate=0.02)
    learnt = [alone.step() for _ in range(8)]
    assert learnt[-1]["mean_accuracy"] > 0.8
    assert metrics[-1]["mean_accuracy"] < learnt[-1]["mean_accuracy"] - 0.1


def test_the_set_is_everybody_who_differs(bank, comparisons):
    popl = build(bank, comparisons)
    popl.step()
    assert 1 <= len(popl.result()) <= 3
    popl.population.replace_(torch.tensor([1, 1, 1]))
    assert len(popl.result()) == 1


def test_reward_functions_learn_alike(bank, comparisons):
    popl = build(bank, comparisons, spec=RewardSpec(5, 2, (6,)))
    assert popl.training.loss.conservatism == 1
    popl.step()
    assert isinstance(popl.result(), RewardSet)
