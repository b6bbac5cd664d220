"""The latent-variable baseline."""

import math

import pytest
import torch
from tensordict import TensorDict

from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.vpl import (
    VPL,
    active_units,
    divergence,
    spread_points,
    swap_guidance,
)
from popl_rl.config import Training, VPLSettings
from popl_rl.data.bank import SegmentBank
from popl_rl.keys import ANSWER, PAIR, RATER
from popl_rl.models.encoded_policy_set import AnswerEncoder, EncodedPolicySet, EncodedRewardSet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import case_values, margins, segment_scores
from popl_rl.models.sets import load_set

SPEC = PolicySpec(5, 2, True, (6,))
CONTINUOUS = PolicySpec(3, 2, False, (6, 6))


def build(bank, comparisons, *, seed=0, spec=SPEC, **settings):
    own = {name: settings.pop(name) for name in ("kl", "latent", "swap") if name in settings}
    generations = settings.pop("generations", 4)
    steps = settings.pop("steps", 3) * generations
    training = Training(steps=steps, **{"batch_size": 32, **settings})
    problem = Problem(spec, bank, comparisons, training, generations=generations)
    generator = torch.Generator().manual_seed(seed)
    return VPL(problem, vpl=VPLSettings(**{"latent": 3, **own}), generator=generator)


def tensors(popl):
    networks = (popl.encoder, popl.network)
    return [value.clone() for network in networks for value in network.state_dict().values()]


def continuous_bank():
    generator = torch.Generator().manual_seed(0)
    row = torch.arange(40).view(10, 4)
    observation = torch.randn(40, 3, generator=generator)
    return SegmentBank(observation, row, torch.randn(10, 4, 2, generator=generator), False)


def test_divergence_by_hand():
    """Of N(1, 1) it is 1/2; of N(0, 2) it is (4 - 1 - 2 log 2) / 2; of both together the sum."""
    both = divergence(torch.tensor([1.0, 0.0]), torch.tensor([1.0, 2.0]).log())
    assert float(both) == pytest.approx(0.5 + 1.5 - math.log(2))
    assert float(divergence(torch.zeros(3), torch.zeros(3))) == 0


def test_swap_guidance_by_hand():
    """Opposed means of the same spread: 0. Equal ones: 2. At right angles, and a logarithm of one
    of two standard deviations off by 2: 1 + 4 / 2."""
    mean, flat = torch.tensor([1.0, 0.0]), torch.zeros(2)
    assert float(swap_guidance(mean, flat, (-3 * mean, flat))) == pytest.approx(0)
    assert float(swap_guidance(mean, flat, (2 * mean, flat))) == pytest.approx(2)
    aside = torch.tensor([0.0, 1.0]), torch.tensor([2.0, 0.0])
    assert float(swap_guidance(mean, flat, aside)) == pytest.approx(3)


def test_active_units_by_hand():
    """Variances over raters of 0, 0.0025 and 1."""
    beliefs = torch.tensor([[0.5, 0.05, 1.0], [0.5, -0.05, -1.0]])
    assert active_units(beliefs) == 1
    assert active_units(beliefs[:1]) == 0


def test_points_far_from_each_other_by_hand():
    """On a line, with the middle at 3: 10 is farthest from it, then 0 from 10, then 4, then 1."""
    points = torch.tensor([[0.0], [1.0], [4.0], [0.0], [10.0]])
    assert spread_points(points, 3).tolist() == [4, 0, 2]
    assert spread_points(points, 4).tolist() == [4, 0, 2, 1]
    assert sorted(spread_points(points, 99).tolist()) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("spec", [SPEC, CONTINUOUS])
def test_the_order_and_the_number_of_answers_do_not_matter(bank, spec, generator):
    bank = bank if spec.discrete else continuous_bank()
    encoder = AnswerEncoder(spec, 3, generator=generator)
    preferred, other = torch.randint(10, (2, 1, 6), generator=generator)
    mean, log_std = encoder(bank, preferred, other)
    assert mean.shape == log_std.shape == (1, 3)
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    for again in (
        encoder(bank, preferred[:, order], other[:, order]),
        encoder(bank, preferred.repeat(1, 2), other.repeat(1, 2)),
    ):
        torch.testing.assert_close(again, (mean, log_std))
    assert not torch.allclose(encoder(bank, other, preferred)[0], mean), "which one won matters"


@pytest.mark.parametrize("spec", [SPEC, CONTINUOUS, PolicySpec(5, 2, True, ())])
def test_what_z_adds_to_the_first_layer_is_a_bias(bank, comparisons, spec, generator):
    """Ordinary policies score as the conditioned one does."""
    bank = bank if spec.discrete else continuous_bank()
    popl = build(bank, comparisons, spec=spec, discount=0.9)
    z = torch.randn(4, 3, generator=generator)
    segment = torch.arange(10).expand(4, -1)
    with torch.no_grad():
        conditioned = popl.scores(segment, z)
    policies = popl.policies_for(z)
    assert policies.spec == spec
    ordinary = segment_scores(policies, bank, alpha=popl.problem.training.alpha, discount=0.9)[
        :, :10
    ]
    torch.testing.assert_close(ordinary, conditioned, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(ordinary[0], ordinary[1])


def test_beliefs_are_those_of_the_encoder_about_all_answers_of_a_rater(bank, comparisons):
    popl = build(bank, comparisons)
    beliefs = popl.beliefs()
    assert beliefs.shape == (8, 3)
    for rater in (0, 5):
        mine = comparisons.rows(comparisons.case == rater)
        mean, _ = popl.encoder(bank, mine.preferred[None], mine.other[None])
        torch.testing.assert_close(beliefs[rater], mean[0].detach())


def test_a_generation_moves_everything_and_reports_numbers(bank, comparisons):
    popl = build(bank, comparisons)
    assert isinstance(popl, VPL)
    before = tensors(popl)
    metrics = popl.step()
    assert set(metrics) == {
        "worst_rater_accuracy",
        "mean_accuracy",
        "loss_cpl",
        "divergence",
        "active_units",
    }
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    assert not any(map(torch.equal, before, tensors(popl)))


def test_a_heavy_divergence_keeps_beliefs_where_nothing_is_known(bank, comparisons):
    def apart(kl):
        popl = build(bank, comparisons, kl=kl, generations=8, steps=8, learning_rate=0.01)
        return [popl.step() for _ in range(8)][-1]["divergence"]

    assert apart(100.0) < 0.05 < apart(0.0)


@pytest.fixture(scope="module")
def _trained():
    return {}


@pytest.fixture
def trained(_trained, bank, comparisons):
    if not _trained:
        popl = build(bank, comparisons, generations=15, steps=15, learning_rate=0.01, batch_size=64)
        for _ in range(15):
            popl.step()
        _trained["popl"] = popl
    return _trained["popl"]


def answers_of(preferences, rater):
    return preferences[preferences[RATER] == rater].select(PAIR, ANSWER)


def test_two_obvious_groups_are_found_and_their_raters_catered_to(
    trained, segments, bank, comparisons, preferences
):
    found = trained.result()
    assert isinstance(found, EncodedPolicySet)
    values = case_values(
        margins(found.population, bank, comparisons, alpha=found.alpha) > 0, comparisons
    )
    picks = []
    for rater in range(8):
        choice = found.cater(segments, answers_of(preferences, rater))
        assert float(choice.weights.sum()) == pytest.approx(1)
        assert int(choice.weights.argmax()) == choice.member
        assert choice.member == found.cater(bank, answers_of(preferences, rater)).member
        picks.append(choice.member)
    left, right = values[picks[:4], :4].mean(), values[picks[4:], 4:].mean()
    assert float(left) > 0.85
    assert float(right) > 0.85
    assert float(values[picks[:4], 4:].mean()) < 0.5, "the left's policies do not serve the right"


def test_the_nearest_in_units_of_the_belief(monkeypatch, trained, bank, preferences):
    """Belief N(0, 1) and N(0, 0.1): (3, 0) is 3 deviations away, (0, 0.5) five.

    The weights are as exp(-9 / 2) to exp(-25 / 2).
    """
    found = trained.result().subset([0, 1])
    found.z = torch.tensor([[0.0, 0.5], [3.0, 0.0]])
    belief = (torch.zeros(1, 2), torch.tensor([[1.0, 0.1]]).log())
    monkeypatch.setattr(found, "encoder", lambda *_: belief)
    choice = found.cater(bank, answers_of(preferences, 0))
    assert choice.member == 1
    assert float(choice.weights[0]) == pytest.approx(math.exp(-8) / (1 + math.exp(-8)), rel=1e-4)


def test_catering_by_lexicase_is_that_of_any_set(trained, bank, preferences):
    found = trained.result()
    plain = PolicySet(found.population, alpha=found.alpha)
    said = answers_of(preferences, 2)
    one, other = (
        policies.cater(
            bank, said, method="lexicase", generator=torch.Generator().manual_seed(3)
        ).member
        for policies in (found, plain)
    )
    assert one == other


def test_the_set_is_bounded_and_part_of_it_can_be_taken(monkeypatch, trained, bank, preferences):
    monkeypatch.setattr("popl_rl.algorithms.vpl._MOST", 5)
    found = trained.result()
    assert len(found) == len(found.z) == len(trained.population) == 5
    part = found.subset([4, 2])
    assert isinstance(part, EncodedPolicySet)
    assert part.origin == [4, 2]
    assert torch.equal(part.z, found.z[[4, 2]])
    assert part.cater(bank, answers_of(preferences, 0)).member in (0, 1)


def test_a_saved_set_keeps_its_encoder(trained, tmp_path, bank, preferences):
    """Loaded again it gives every rater the same policy, with the same belief."""
    found = trained.result()
    found.save(tmp_path / "policies")
    loaded = load_set(tmp_path / "policies")
    assert type(loaded) is EncodedPolicySet
    assert torch.equal(loaded.z, found.z)
    for rater in range(8):
        said = answers_of(preferences, rater)
        one, other = found.cater(bank, said), loaded.cater(bank, said)
        assert one.member == other.member
        assert torch.equal(one.weights, other.weights)
    with pytest.raises(FileNotFoundError, match=r"encoded_policy_set.json: read it with load_set"):
        PolicySet.load(tmp_path / "policies")


def test_looking_at_the_population_changes_nothing(bank, comparisons):
    """Snapshots for pictures do, as often as somebody wants."""
    one, other = build(bank, comparisons), build(bank, comparisons)
    one.step()
    other.step()
    assert len(one.population) == 8
    one.result()
    assert one.step() == other.step()


def test_what_it_cannot_do_is_said(bank, comparisons):
    with pytest.raises(ValueError, match=r"method vpl needs a hidden layer"):
        build(bank, comparisons, spec=RewardSpec(5, 2, ()))
    with pytest.raises(ValueError, match="latent must be at least 1, got 0"):
        build(bank, comparisons, latent=0)
    with pytest.raises(ValueError, match=r"kl must be at least 0, got -1"):
        build(bank, comparisons, kl=-1)


def test_reward_functions_are_learnt_and_kept_likewise(bank, comparisons, tmp_path):
    method = build(bank, comparisons, spec=RewardSpec(5, 2, (6,)))
    method.step()
    found = method.result()
    found.save(tmp_path / "rewards")
    loaded = load_set(tmp_path / "rewards")
    assert isinstance(loaded, EncodedRewardSet)
    answers = TensorDict({"pair": torch.tensor([[0, 1]]), "answer": torch.tensor([0])}, [1])
    assert loaded.cater(bank, answers).member == found.cater(bank, answers).member


def test_guidance_mirrors_beliefs_about_who_said_the_opposite(bank, comparisons):
    def mirrored(swap):
        popl = build(bank, comparisons, swap=swap, generations=20, steps=10, learning_rate=0.02)
        for _ in range(20):
            popl.step()
        mine = [comparisons.rows(comparisons.case == rater) for rater in range(8)]
        beliefs, opposite = (
            [popl.encoder(bank, *sides(one)) for one in mine]
            for sides in (
                lambda one: (one.preferred[None], one.other[None]),
                lambda one: (one.other[None], one.preferred[None]),
            )
        )
        guided = [
            swap_guidance(*own, swapped) for own, swapped in zip(beliefs, opposite, strict=True)
        ]
        return float(torch.cat(guided).mean().detach())

    assert mirrored(1.0) < 0.2
    assert mirrored(0.0) > 2 * mirrored(1.0)
