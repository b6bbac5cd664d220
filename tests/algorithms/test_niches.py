"""POPL with rater ids: who is there at the end, and by what steps."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.niches import NichePOPL
from popl_rl.algorithms.problem import Problem
from popl_rl.config import NicheSettings, POPLSettings, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.envs.hidden_utility import sample_states
from popl_rl.models.reward_functions import RewardSpec, reward_bank
from popl_rl.models.scoring import case_values

SPEC = RewardSpec(1, 1, (32, 32))
POPL = POPLSettings(specialist_steps=10, pooled_steps=20)


def ring(groups, *, raters=12, answers=12, seed=0):
    """Raters of groups evenly on a ring: bank, comparisons and the group of each rater."""
    generator = torch.Generator().manual_seed(seed)
    states = sample_states(400, generator=generator)
    group = torch.arange(raters * groups) % groups
    rater = torch.arange(len(group)).repeat_interleave(answers)
    pair = torch.randint(400, (len(rater), 2), generator=generator)
    value = states["observation"][:, 0, 0][pair] + (group[rater] / groups).unsqueeze(1)
    first = (value.remainder(1)[:, 0] > value.remainder(1)[:, 1]).long()
    row = torch.arange(len(rater))
    comparisons = Comparisons(pair[row, 1 - first], pair[row, first], rater, len(group))
    return reward_bank(states), comparisons, group


def build(bank: SegmentBank, comparisons, *, seed=0, members=8, steps=400, **more):
    training = Training(steps=steps, batch_size=64, learning_rate=0.02)
    problem = Problem(SPEC, bank, comparisons, training, members=members, generations=20)
    generator = torch.Generator().manual_seed(seed)
    popl = replace(POPL, **more)
    return NichePOPL(problem, popl=popl, niches=NicheSettings(), generator=generator)


def run(method):
    metrics = [method.step() for _ in range(method.generations)]
    return method.result(), metrics


def served(found, bank, comparisons, group):
    """How right the best member is on the raters of each group."""
    values = case_values(found.margins(bank, comparisons) > 0, comparisons)
    return [float(values[:, group == one].mean(1).max()) for one in group.unique()]


@pytest.mark.parametrize("groups", [1, 2])
def test_it_finds_as_many_as_there_are(groups):
    bank, comparisons, group = ring(groups)
    method = build(bank, comparisons)
    found, metrics = run(method)
    assert len(found) == groups
    assert min(served(found, bank, comparisons, group)) > 0.9
    assert metrics[-1]["members"] == groups
    assert [size for size, _, _ in method.sizes] == list(range(1, len(method.sizes) + 1))


def test_half_of_the_raters_say_nothing_to_a_copy():
    """Labels of one half turned round: the copy that never learns of it stays the same."""
    bank, comparisons, _ = ring(2)
    one = build(bank, comparisons)
    weight = one._trained_on()
    half = one.half[comparisons.case]
    assert torch.equal(weight.sum(0), torch.ones_like(half))
    assert torch.equal(weight[0], half)
    told = one._told(torch.stack([torch.zeros(len(half)), torch.ones(len(half))]))
    assert torch.equal(told.squeeze(0), half.float())


def test_too_few_members_are_said():
    bank, comparisons, _ = ring(4, raters=15)
    method = build(bank, comparisons, members=2)
    with pytest.warns(UserWarning, match="raise method.members"):
        run(method)


def test_another_rule_may_select():
    bank, comparisons, group = ring(2)
    found, _ = run(build(bank, comparisons, selection="random"))
    assert min(served(found, bank, comparisons, group)) > 0.8


def test_a_single_rater_has_no_groups():
    bank, comparisons, _ = ring(1, raters=1)
    with pytest.raises(ValueError, match="at least 2 raters"):
        build(bank, comparisons)


@pytest.mark.parametrize("at", [2, 9, 15])
def test_it_goes_on_to_the_bit(at):
    bank, comparisons, _ = ring(2, raters=6)
    through, before = build(bank, comparisons, steps=60), build(bank, comparisons, steps=60)
    for _ in range(at):
        before.step()
    after = build(bank, comparisons, steps=60)
    after.load_state_dict(before.state_dict())
    for _ in range(at, through.generations):
        after.step()
    for _ in range(through.generations):
        through.step()
    assert torch.equal(through.share, after.share)
    assert through.sizes == after.sizes
    for one, other in zip(
        through.population.members.data.values(True, True),
        after.population.members.data.values(True, True),
        strict=True,
    ):
        assert torch.equal(one, other)
