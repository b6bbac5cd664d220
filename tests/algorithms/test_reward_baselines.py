import pytest
import torch
from torch import nn

from popl_rl.algorithms.reward_baselines import brex_set, segment_features, train_reward_baselines
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.reward_functions import RewardSpec, reward_bank
from popl_rl.models.scoring import segment_scores


@pytest.fixture
def spec():
    return RewardSpec(5, 2, (16,))


@pytest.fixture
def comparisons(preferences):
    return Comparisons.from_preferences(preferences, cases="preference")


@pytest.fixture
def bank(segments):
    return reward_bank(segments)


def test_features_are_counted_once_for_each_action(segments, bank):
    # With the observation itself as its features: how often which cell was left how.
    features = segment_features(nn.Identity(), bank, 2).view(len(bank), 2, 5)
    for segment in range(len(bank)):
        for action in range(2):
            taken = segments["action"][segment] == action
            seen = segments["observation"][segment][taken].sum(0)
            torch.testing.assert_close(features[segment, action], seen)


def test_samples_of_the_posterior_are_a_set_of_reward_functions(spec, bank, comparisons, generator):
    found = brex_set(spec, bank, comparisons, steps=200, keep=30, generator=generator)
    assert len(found) == 30
    assert found.population.spec == RewardSpec(5, 2, (512,))
    heads = found.population.members["0", "weight"]
    torch.testing.assert_close(heads.flatten(1).norm(dim=1), torch.ones(30))
    # The set scores as the chain did: by the heads on the summed features.
    features = segment_features(found.population.trunk, bank, 2)
    scores = segment_scores(found.population, bank)
    torch.testing.assert_close(scores, (features @ heads.flatten(1).T).T, rtol=1e-4, atol=1e-4)


def test_the_chain_explains_comparisons_better_than_chance(spec, bank, comparisons, generator):
    one_group = comparisons.rows(torch.arange(len(comparisons) // 2))
    found = brex_set(spec, bank, one_group, steps=2000, keep=50, generator=generator)
    scores = segment_scores(found.population, bank)
    passes = scores[:, one_group.preferred] > scores[:, one_group.other]
    assert passes.float().mean() > 0.8


def test_rivals_score_every_segment(spec, bank, comparisons, generator):
    reward_baselines = train_reward_baselines(
        spec, bank, comparisons, brex_steps=50, dpl_steps=5, generator=generator
    )
    scores = reward_baselines.scores(bank)
    assert sorted(scores) == [
        ("dpl_categorical", "expectation"),
        ("dpl_categorical", "risk_averse"),
        ("dpl_mean_variance", "expectation"),
        ("dpl_mean_variance", "risk_averse"),
    ]
    for score in scores.values():
        assert score.shape == (len(bank),)
        assert score.isfinite().all()
    assert (
        scores["dpl_mean_variance", "risk_averse"] < scores["dpl_mean_variance", "expectation"]
    ).all()
