import math

import pytest
import torch

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.variation import GaussianHead, GradientCPL
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population

SPEC = PolicySpec(5, 2, True, (6,))


def flat(population):
    """All parameters of each member in a row."""
    return torch.cat([v.flatten(1) for v in population.members.data.values(True, True)], 1)


@pytest.fixture
def heads(generator):
    return Population.create(SPEC, 30, evolve="head", generator=generator)


@pytest.fixture
def whole(generator):
    return Population.create(SPEC, 4, generator=generator)


def gradient(population, bank, comparisons, *, seed=0, **arguments):
    generator = torch.Generator().manual_seed(seed)
    loss = CPLLoss(population, bank)
    defaults = {"generations": 10, "steps": 3, "batch_size": 16, "learning_rate": 1e-2}
    return GradientCPL(loss, comparisons, generator=generator, **{**defaults, **arguments})


def moments(variation):
    """Copies of Adam's moments of every parameter."""
    states = variation.optimizer.state.values()
    return [state[name].clone() for state in states for name in ("exp_avg", "exp_avg_sq")]


def test_heads_start_with_unit_norm_and_unchanged_direction(heads, generator):
    before = flat(heads)
    GaussianHead(heads, generator=generator)
    after = flat(heads)
    torch.testing.assert_close(after.norm(dim=1), torch.ones(30))
    torch.testing.assert_close(after * before.norm(dim=1, keepdim=True), before)


def test_a_mutation_changes_one_coordinate_and_renormalises(heads, generator):
    """A child is (p + z e_k) / |p + z e_k|: all coordinates but k shrink by one factor.

    The factor is 1 / |p + z e_k|, so undoing it must give back the parent everywhere but in k.
    """
    variation = GaussianHead(heads, std=0.5, generator=generator)
    parents = torch.randint(30, (30,), generator=generator)
    before = flat(heads)[parents]
    assert variation(parents, torch.zeros(30, 1)) == {}
    after = flat(heads)
    torch.testing.assert_close(after.norm(dim=1), torch.ones(30))
    coordinates = set()
    for old, new in zip(before, after, strict=True):
        factor = (old / new).median()
        changed = ((new * factor - old).abs() > 1e-5).nonzero().squeeze(-1).tolist()
        assert len(changed) == 1
        torch.testing.assert_close(float((new * factor).norm()), float(factor))
        coordinates.update(changed)
    # Weights and biases are all drawn: 6 * 2 + 2 = 14 coordinates.
    assert len(coordinates) > 7
    assert max(coordinates) <= 13


def test_mutations_have_the_given_spread(heads, generator):
    """After undoing the renormalisation what was added is N(0, 0.05): 1500 draws, to 4 sigma."""
    variation = GaussianHead(heads, std=0.05, generator=generator)
    noise = []
    for _ in range(50):
        before = flat(heads)
        variation(torch.arange(30), torch.zeros(30, 1))
        after = flat(heads)
        factor = (before / after).median(1, keepdim=True).values
        noise.append((after * factor - before).sum(1))
    noise = torch.cat(noise)
    assert float(noise.std()) == pytest.approx(0.05, rel=4 / math.sqrt(2 * 1500))
    assert float(noise.mean()) == pytest.approx(0, abs=4 * 0.05 / math.sqrt(1500))


def test_the_trunk_stays_as_it_is(heads, generator):
    before = {name: value.clone() for name, value in heads.trunk.state_dict().items()}
    variation = GaussianHead(heads, generator=generator)
    variation(torch.arange(30), torch.zeros(30, 1))
    assert before
    for name, value in heads.trunk.state_dict().items():
        assert torch.equal(value, before[name])


def test_gaussian_mutation_is_reproducible():
    def mutate(seed):
        heads = Population.create(
            SPEC, 5, evolve="head", generator=torch.Generator().manual_seed(0)
        )
        variation = GaussianHead(heads, generator=torch.Generator().manual_seed(seed))
        variation(torch.arange(5), torch.zeros(5, 1))
        return flat(heads)

    assert torch.equal(mutate(1), mutate(1))
    assert not torch.equal(mutate(1), mutate(2))


def test_gaussian_mutation_needs_heads(whole, generator):
    message = "population must have evolve='head' for Gaussian mutation, got 'all'; set method"
    with pytest.raises(ValueError, match=message):
        GaussianHead(whole, generator=generator)


@pytest.mark.parametrize("std", [0.0, -1.0, math.nan])
def test_gaussian_mutation_needs_a_spread(heads, generator, std):
    with pytest.raises(ValueError, match=f"std must be positive, got {std}"):
        GaussianHead(heads, std=std, generator=generator)


def test_children_start_from_their_parents(whole, bank, comparisons):
    """With a step size that is next to nothing, children are copies of their parents."""
    variation = gradient(whole, bank, comparisons, learning_rate=1e-12)
    parents = torch.tensor([2, 2, 0, 1])
    before = flat(whole)
    variation(parents, torch.ones(4, comparisons.num_cases))
    torch.testing.assert_close(flat(whole), before[parents], atol=1e-7, rtol=0)


def test_children_learn_from_what_they_are_told(whole, bank, comparisons):
    """Children 0 and 3 are told rater 5 alone, the others rater 7; see what is drawn."""
    variation = gradient(whole, bank, comparisons, batch_size=50, steps=1)
    strength = torch.zeros(4, comparisons.num_cases)
    strength[[0, 3], 5] = strength[[1, 2], 7] = 1.0
    seen = []
    variation.loss.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    variation(torch.tensor([3, 1, 1, 3]), strength)
    for key, column in (("preferred", comparisons.preferred), ("other", comparisons.other)):
        drawn = seen[0][key]
        for child, rater in enumerate([5, 7, 7, 5]):
            said = column[comparisons.case == rater]
            assert float(torch.isin(drawn[child], said).float().mean()) > 0.95


def test_a_parent_that_is_strong_nowhere_learns_from_everything(whole, bank, comparisons):
    variation = gradient(whole, bank, comparisons, batch_size=500, steps=1)
    seen = []
    variation.loss.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    variation(torch.arange(4), torch.zeros(4, comparisons.num_cases))
    drawn = set(seen[0]["preferred"].flatten().tolist())
    assert drawn == set(comparisons.preferred.tolist())


def test_children_inherit_their_parents_moments(whole, bank, comparisons):
    """Moments before the second call are those of the parents, row by row."""
    variation = gradient(whole, bank, comparisons, steps=2)
    variation(torch.arange(4), torch.ones(4, comparisons.num_cases))
    held = moments(variation)
    parents = torch.tensor([3, 3, 0, 1])
    seen = []

    def look(*_):
        if not seen:
            seen.extend(moments(variation))

    variation.loss.register_forward_pre_hook(look)
    variation(parents, torch.ones(4, comparisons.num_cases))
    assert len(held) == len(seen) == 2 * 4
    for old, new in zip(held, seen, strict=True):
        assert bool(old.any())
        assert torch.equal(old[parents], new)


def test_warming_up_is_pooled_cpl(whole, bank, comparisons):
    seen = []
    before = flat(whole)
    variation = gradient(whole, bank, comparisons, batch_size=300)
    variation.loss.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    variation.warm_up(2)
    assert len(seen) == 2
    assert set(seen[0]["preferred"].flatten().tolist()) == set(comparisons.preferred.tolist())
    assert bool((flat(whole) != before).any(1).all())
    variation.warm_up(0)
    assert len(seen) == 2


def test_a_gradient_step_lowers_the_loss_and_reports_it(whole, bank, comparisons):
    variation = gradient(whole, bank, comparisons, generations=40)
    strength = torch.zeros(4, comparisons.num_cases)
    strength[:, :5] = 1
    losses = [variation(torch.arange(4), strength)["loss_cpl"] for _ in range(40)]
    assert sum(losses[-5:]) < sum(losses[:5])


def test_the_step_size_falls_to_zero_at_the_last_generation(whole, bank, comparisons):
    variation = gradient(whole, bank, comparisons, generations=4, learning_rate=0.1)
    rates = []
    for _ in range(4):
        rates.append(variation.optimizer.param_groups[0]["lr"])
        variation(torch.arange(4), torch.ones(4, comparisons.num_cases))
    assert rates == pytest.approx([0.1, 0.1, 0.1, 0.05])


def test_state_round_trips_while_training_goes_on(whole, bank, comparisons):
    """A state is of the moment at which it was taken, not of what the optimiser does later."""
    variation = gradient(whole, bank, comparisons)
    everything = torch.ones(4, comparisons.num_cases)
    variation(torch.arange(4), everything)
    state, members = variation.state_dict(), whole.members.data.clone()
    generator_state = variation.generator.get_state()
    variation(torch.arange(4), everything)
    expected = flat(whole)

    other = Population.create(SPEC, 4, generator=torch.Generator().manual_seed(5))
    other.members.data.update_(members)
    restored = gradient(other, bank, comparisons, seed=9)
    restored.generator.set_state(generator_state)
    restored.load_state_dict(state)
    restored(torch.arange(4), everything)
    assert torch.equal(flat(other), expected)


def test_the_state_of_gaussian_mutation_is_empty(heads, generator):
    variation = GaussianHead(heads, generator=generator)
    before = flat(heads)
    variation.load_state_dict(variation.state_dict())
    assert torch.equal(flat(heads), before)
