import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.algorithms import mixture_population as teams
from popl_rl.algorithms.mixture_population import MixturePOPL, MixtureSettings
from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet

SMALL = MixtureSettings(
    teams=4,
    sizes=(1, 2, 3),
    generations=6,
    steps=3,
    batch_size=32,
    bundle=5,
    first_selection=1,
    exchange=0.5,
    removal=0.5,
    polish_steps=50,
    folds=2,
)
SPEC = PolicySpec(5, 2, True, (8,))


def make(bank, comparisons, *, seed=0, **changes):
    small = MixtureSettings(**{**vars(SMALL), **changes})
    generator = torch.Generator().manual_seed(seed)
    return MixturePOPL(SPEC, bank, comparisons, settings=small, generator=generator)


def parameters_of(popl):
    return [value.clone() for value in popl.population.members.data.values(True, True)]


def equal(one, other):
    return all(map(torch.equal, one, other))


def test_the_likelihood_of_a_team_by_hand(bank, comparisons):
    """Members that prefer with chances 0.8 and 0.4, shares 3/4 and 1/4: 0.6 + 0.1 = 0.7.

    A team of the first alone, next to an empty place, is as likely as that member: 0.8.
    """
    popl = make(bank, comparisons, teams=2, sizes=(2, 1))
    popl.share = torch.tensor([[0.75, 0.25], [1.0, 0.0]])
    chance = torch.tensor([[0.8], [0.4], [0.8], [0.999]])
    explained = popl._explain(chance.log())
    torch.testing.assert_close(explained.exp(), torch.tensor([[0.7], [0.8]]))


def test_first_shares_are_equal_and_only_of_taken_places(bank, comparisons):
    popl = make(bank, comparisons)
    assert popl.active.sum(1).tolist() == [1, 2, 3, 1]
    expected = [[1, 0, 0], [1 / 2, 1 / 2, 0], [1 / 3, 1 / 3, 1 / 3], [1, 0, 0]]
    torch.testing.assert_close(popl.share, torch.tensor(expected))


def test_shares_are_mean_responsibilities_by_hand(monkeypatch, bank, comparisons):
    """Chances 0.9 and 0.3 on one preference and 0.3 and 0.9 on another, shares 1/2 and 1/2.

    Responsibilities of the first member are 0.9 / 1.2 and 0.3 / 1.2, their mean 1/2; with shares
    3/4 and 1/4 they are 2.7 / 3.0 and 0.9 / 1.8, their mean 0.7.
    """
    popl = make(bank, comparisons, teams=2, sizes=(2,))
    odds = torch.logit(torch.tensor([[0.9, 0.3], [0.3, 0.9]]))
    monkeypatch.setattr(teams, "margins", lambda *_, **__: odds.repeat(2, 1))
    popl.share = torch.tensor([[0.5, 0.5], [0.75, 0.25]])
    belongs = popl._responsibility()
    expected = torch.tensor([[0.75, 0.25], [0.25, 0.75], [0.9, 0.5], [0.1, 0.5]])
    torch.testing.assert_close(belongs, expected)
    torch.testing.assert_close(popl.share, torch.tensor([[0.5, 0.5], [0.7, 0.3]]))


def test_shares_sum_to_one_and_removed_members_stay_away(bank, comparisons):
    popl = make(bank, comparisons, generations=20, removal=1.0, exchange=0.0, sizes=(3,))
    size = popl.active.sum()
    for _ in range(6):
        popl.step()
        torch.testing.assert_close(popl.share.sum(1), torch.ones(4))
        assert bool((popl.share[~popl.active] == 0).all())
        assert bool((popl.share >= 0).all())
        assert bool(popl.active.any(1).all())
        assert popl.active.sum() <= size
        size = popl.active.sum()
    assert size < 12


def test_a_removed_member_never_comes_back(bank, comparisons):
    """Whatever is bred, the places of a child are a part of its parent's."""
    popl = make(bank, comparisons, removal=1.0, exchange=1.0)
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        parents = torch.randint(4, (4,), generator=generator)
        before = popl.active.clone()
        popl._replace(parents)
        assert not bool((popl.active & ~before[parents]).any())
        torch.testing.assert_close(popl.share.sum(1), torch.ones(4))


def test_the_first_child_is_its_parents_copy(bank, comparisons):
    popl = make(bank, comparisons, removal=1.0, exchange=1.0)
    popl.step()
    before, active, share = parameters_of(popl), popl.active.clone(), popl.share.clone()
    popl._replace(torch.tensor([2, 0, 3, 1]))
    order = [2, 0, 3, 1]
    assert torch.equal(popl.active, active[order])
    torch.testing.assert_close(popl.share, share[order])
    for old, new in zip(before, parameters_of(popl), strict=True):
        assert torch.equal(new.unflatten(0, (4, 3)), old.unflatten(0, (4, 3))[order])


def test_visit_counts_by_hand():
    """Rows 0, 1, 0 with actions 1, 0, 1 and discount 1/2: (0, 1) gets 1 + 1/4, (1, 0) gets 1/2."""
    bank = SegmentBank(torch.eye(2), torch.tensor([[0, 1, 0]]), torch.tensor([[1, 0, 1]]), True)
    counts = teams._visit_counts(bank, PolicySpec(2, 2, True, ()), 0.5)
    assert counts.tolist() == [[0, 1.25, 0.5, 0]]


@given(st.integers(0, 2**31), st.floats(0.5, 1.0), st.floats(0.1, 1.0))
@settings(max_examples=10, deadline=None)
def test_visit_counts_give_the_margins_of_the_loss(seed, discount, conservatism):
    generator = torch.Generator().manual_seed(seed)
    row = torch.randint(5, (40, 4), generator=generator)
    action = torch.randint(2, (40, 4), generator=generator)
    bank = SegmentBank(torch.eye(5), row, action, True)
    pair = torch.randint(40, (2, 60), generator=generator)
    comparisons = teams.Comparisons(*pair, torch.arange(60), 60)
    popl = make(bank, comparisons, discount=discount, conservatism=conservatism)
    index = torch.arange(60)
    assert popl._counts is not None
    fast = popl._batch_margins(popl.loss, index)
    popl._counts = None
    torch.testing.assert_close(popl._batch_margins(popl.loss, index), fast, rtol=1e-4, atol=1e-5)


def test_without_shared_observations_there_are_no_counts():
    generator = torch.Generator().manual_seed(0)
    observation, action = torch.randn(30, 5), torch.randint(2, (10, 3))
    bank = SegmentBank(observation, torch.arange(30).view(10, 3), action, False)
    assert teams._visit_counts(bank, SPEC, 1.0) is None
    pair = torch.randint(10, (2, 60), generator=generator)
    popl = make(bank, teams.Comparisons(*pair, torch.arange(60), 60))
    assert all(math.isfinite(value) for value in popl.step().values())


def test_the_seed_decides_everything(bank, comparisons):
    def run(seed):
        popl = make(bank, comparisons, seed=seed)
        metrics = [popl.step() for _ in range(4)]
        return metrics, parameters_of(popl), popl.policies().population.members.data

    metrics, parameters, chosen = run(0)
    again, same, same_chosen = run(0)
    assert metrics == again
    assert equal(parameters, same)
    assert equal(chosen.values(True, True), same_chosen.values(True, True))
    assert not any(map(torch.equal, parameters, run(1)[1]))


@pytest.mark.parametrize("after", [0, 2])
def test_continuing_is_as_never_having_stopped(bank, comparisons, after):
    straight = make(bank, comparisons)
    for _ in range(after):
        straight.step()
    state = straight.state_dict()
    expected = [straight.step() for _ in range(3)]
    # What is held out is drawn from the seed when a team is built, so the seed is the same.
    resumed = make(bank, comparisons)
    resumed.step()
    resumed.load_state_dict(state)
    assert [resumed.step() for _ in range(3)] == expected
    assert resumed.generation == straight.generation == after + 3
    assert equal(parameters_of(resumed), parameters_of(straight))
    assert torch.equal(resumed.active, straight.active)
    assert torch.equal(resumed.share, straight.share)
    one, other = straight.policies(), resumed.policies()
    assert equal(
        one.population.members.data.values(True, True),
        other.population.members.data.values(True, True),
    )


def test_too_few_preferences_are_refused(bank, comparisons):
    with pytest.raises(ValueError, match=r"enough to hold 20 out of 20%, got 30; collect more"):
        make(bank, comparisons.rows(torch.arange(30)), bundle=20)


def test_every_generation_moves_the_members_and_reports_numbers(bank, comparisons):
    popl = make(bank, comparisons)
    before = parameters_of(popl)
    metrics = popl.step()
    assert set(metrics) == {
        "worst_rater_accuracy",
        "mean_accuracy",
        "held_out_likelihood",
        "selection_depth",
        "distinct",
        "effective_parents",
        "team_size",
        "loss",
    }
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    assert not any(map(torch.equal, before, parameters_of(popl)))


def test_the_result_is_a_team_that_acts(bank, comparisons, generator, tmp_path):
    popl = make(bank, comparisons)
    for _ in range(SMALL.generations):
        popl.step()
    policies = popl.policies()
    assert isinstance(policies, PolicySet)
    assert 1 <= len(policies) <= 3
    action = policies.act(torch.eye(5), member=0, generator=generator)
    assert action.shape == (5,)
    assert set(action.tolist()) <= {0, 1}
    policies.save(tmp_path / "set")
    assert len(PolicySet.load(tmp_path / "set")) == len(policies)


def test_part_of_a_team_can_be_taken(bank, comparisons):
    """Polished members are members of no population, so there is no origin to look up."""
    policies = make(bank, comparisons).policies()
    part = policies.subset([0])
    assert len(part) == 1
    assert part.origin == []


def test_a_team_of_one_is_enough_if_it_is_as_good(monkeypatch, bank, comparisons):
    """Teams of 1, 2 and 3 members that all explain alike: the smallest is chosen."""
    popl = make(bank, comparisons, teams=3)
    monkeypatch.setattr(
        popl, "_explain", lambda log_odds: torch.full((3, log_odds.shape[1]), math.log(0.7))
    )
    assert len(popl.policies()) == 1
