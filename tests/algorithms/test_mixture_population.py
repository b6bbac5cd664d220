import math

import pytest
import torch

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.mixture_population import MixturePOPL
from popl_rl.algorithms.problem import Problem
from popl_rl.config import MixtureSettings, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet

SMALL = MixtureSettings(
    mixtures=4,
    generations=6,
    steps=3,
    bundle=5,
    first_selection=1,
    exchange=0.5,
    removal=0.5,
    final_steps=50,
    folds=2,
)
SPEC = PolicySpec(5, 2, True, (8,))


def make(bank, comparisons, *, seed=0, recipe=None, **changes):
    small = MixtureSettings(**{**vars(SMALL), **changes})
    training = Training(**{"batch_size": 32, **(recipe or {})})
    problem = Problem(SPEC, bank, comparisons, training)
    generator = torch.Generator().manual_seed(seed)
    return MixturePOPL(problem, settings=small, generator=generator)


def parameters_of(popl):
    return [value.clone() for value in popl.population.members.data.values(True, True)]


def equal(one, other):
    return all(map(torch.equal, one, other))


def test_first_shares_are_equal_and_only_of_taken_places(bank, comparisons):
    popl = make(bank, comparisons)
    assert popl.active.sum(1).tolist() == [2, 2, 2, 3]
    expected = [[1 / 2, 1 / 2, 0]] * 3 + [[1 / 3, 1 / 3, 1 / 3]]
    torch.testing.assert_close(popl.share, torch.tensor(expected))


def test_shares_sum_to_one_and_removed_members_stay_away(bank, comparisons):
    popl = make(bank, comparisons, mixtures=8, generations=20, removal=1.0, exchange=0.0)
    size = popl.active.sum()
    for _ in range(6):
        popl.step()
        torch.testing.assert_close(popl.share.sum(1), torch.ones(8))
        assert bool((popl.share[~popl.active] == 0).all())
        assert bool((popl.share >= 0).all())
        assert bool(popl.active.any(1).all())
        assert popl.active.sum() <= size
        size = popl.active.sum()
    assert size < 18


def test_a_removed_member_never_comes_back(bank, comparisons):
    """Whatever is bred, no mixture has more members than the largest of its generation."""
    popl = make(bank, comparisons, generations=20, removal=1.0, exchange=1.0)
    most = int(popl.active.sum(1).max())
    for _ in range(10):
        popl.step()
        assert int(popl.active.sum(1).max()) <= most
        most = int(popl.active.sum(1).max())
        torch.testing.assert_close(popl.share.sum(1), torch.ones(4))


def test_observations_that_never_repeat_train_too():
    generator = torch.Generator().manual_seed(0)
    observation, action = torch.randn(30, 5), torch.randint(2, (10, 3))
    bank = SegmentBank(observation, torch.arange(30).view(10, 3), action, False)
    pair = torch.randint(10, (2, 60), generator=generator)
    popl = make(bank, Comparisons(*pair, torch.arange(60), 60))
    assert all(math.isfinite(value) for value in popl.step().values())
    assert len(popl.result()) >= 1


def test_the_fast_path_of_shared_observations_changes_nothing(bank, comparisons):
    """The final training counts visits where observations repeat, and walks where they do not."""
    apart = SegmentBank(
        bank.observation[bank.row.flatten()],
        torch.arange(bank.row.numel()).view(bank.row.shape),
        bank.action,
        False,
    )
    shared, walked = (
        make(kind, comparisons, recipe={"discount": 0.9}).result() for kind in (bank, apart)
    )
    for one, other in zip(
        shared.population.members.data.values(True, True),
        walked.population.members.data.values(True, True),
        strict=True,
    ):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_the_seed_decides_everything(bank, comparisons):
    def run(seed):
        popl = make(bank, comparisons, seed=seed)
        metrics = [popl.step() for _ in range(4)]
        return metrics, parameters_of(popl), popl.result().population.members.data

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
    # What is held out is drawn from the seed when mixtures are built, so the seed is the same.
    resumed = make(bank, comparisons)
    resumed.step()
    resumed.load_state_dict(state)
    assert [resumed.step() for _ in range(3)] == expected
    assert resumed.generation == straight.generation == after + 3
    assert equal(parameters_of(resumed), parameters_of(straight))
    assert torch.equal(resumed.active, straight.active)
    assert torch.equal(resumed.share, straight.share)
    one, other = straight.result(), resumed.result()
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
        "mixture_size",
        "loss",
    }
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    assert not any(map(torch.equal, before, parameters_of(popl)))


def test_the_result_is_a_mixture_that_acts(bank, comparisons, generator, tmp_path):
    popl = make(bank, comparisons)
    for _ in range(SMALL.generations):
        popl.step()
    policies = popl.result()
    assert isinstance(policies, PolicySet)
    assert 1 <= len(policies) <= 3
    action = policies.act(torch.eye(5), member=0, generator=generator)
    assert action.shape == (5,)
    assert set(action.tolist()) <= {0, 1}
    policies.save(tmp_path / "set")
    assert len(PolicySet.load(tmp_path / "set")) == len(policies)


def test_cloning_weighs_what_is_asked_beside_what_a_member_speaks_for(
    bank, comparisons, monkeypatch
):
    """Members divide all preferences in each copy; what a fold lacks is made up for."""
    popl = make(bank, comparisons, recipe={"bc": 2.0})
    popl.step()
    known = []
    losses = CPLLoss.losses

    def watched(self, *arguments):
        known.append(self.num_answers.clone())
        return losses(self, *arguments)

    monkeypatch.setattr(CPLLoss, "losses", watched)
    size = len(popl.result())
    answers = known[-1].view(SMALL.folds + 1, size).sum(1)
    torch.testing.assert_close(answers, torch.full((3,), float(len(comparisons))))


def test_part_of_a_mixture_can_be_taken(bank, comparisons):
    """Refined members are members of no population, so there is no origin to look up."""
    policies = make(bank, comparisons).result()
    part = policies.subset([0])
    assert len(part) == 1
    assert part.origin == []
