"""Adam over a population that grows and shrinks."""

import torch

from popl_rl.algorithms.stacked_adam import StackedAdam
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population

SPEC = PolicySpec(3, 2, True, (4,))


def trained(count, generator):
    population = Population.create(SPEC, count, generator=generator)
    adam = StackedAdam(population, 0.01)
    for _ in range(3):
        output = population(torch.rand(5, 3, generator=generator))
        adam.optimizer.zero_grad()
        output.square().sum().backward()
        adam.optimizer.step()
    return population, adam


def moments(adam, name):
    return [
        adam.optimizer.state[weight][name] for weight in adam.optimizer.param_groups[0]["params"]
    ]


def test_moments_go_where_members_go(generator):
    population, adam = trained(3, generator)
    moved = adam.moved_to(population.subset([2, 0]), [2, 0])
    for name in ("exp_avg", "exp_avg_sq"):
        for before, after in zip(moments(adam, name), moments(moved, name), strict=True):
            torch.testing.assert_close(after, before[[2, 0]], rtol=0, atol=0)


def test_a_new_member_starts_at_rest_with_the_others_scale(generator):
    population, adam = trained(3, generator)
    moved = adam.moved_to(population.subset([1, 1]), [1, 7])
    for first in moments(moved, "exp_avg"):
        assert not first[1].any()
    for before, after in zip(
        moments(adam, "exp_avg_sq"), moments(moved, "exp_avg_sq"), strict=True
    ):
        torch.testing.assert_close(after[1], before.mean(0))


def test_one_that_never_stepped_has_nothing_to_move(generator):
    population = Population.create(SPEC, 2, generator=generator)
    moved = StackedAdam(population, 0.01).moved_to(population.subset([0]), [0])
    assert not moved.optimizer.state


def test_what_is_kept_no_longer_changes(generator):
    population, adam = trained(2, generator)
    state = adam.state_dict()
    before = state["state"][0]["exp_avg"].clone()
    population(torch.rand(5, 3, generator=generator)).square().sum().backward()
    adam.optimizer.step()
    torch.testing.assert_close(state["state"][0]["exp_avg"], before)
