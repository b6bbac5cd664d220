"""Sets whose scale was chosen explain ties by a threshold of the same scale."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.experiments import people_training
from popl_rl.experiments.people import Fold
from popl_rl.experiments.people_training import as_trained, set_predictors
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.sets import as_set


@pytest.fixture
def told():
    """Members with a quarter of the right margins, and with these, of 30 people with ties."""
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(40, 1, generator=generator)
    pair = torch.rand(1200, 40, generator=generator).argsort(1)[:, :2]
    margin = value[pair[:, 1], 0] - value[pair[:, 0], 0]
    second, first = (margin - 1).sigmoid(), (-margin - 1).sigmoid()
    chance = torch.stack([first, second, 1 - first - second], 1)
    answer = chance.multinomial(1, generator=generator)[:, 0]
    data = TensorDict({"pair": pair, "answer": answer, "rater": torch.arange(1200) % 30}, [1200])
    said = Comparisons.from_preferences(data, cases="rater", ties="rao_kupper")
    said = replace(said, threshold=1.0)
    strict = Comparisons.from_preferences(data, cases="rater")
    bank = SegmentBank(value, torch.arange(40)[:, None], torch.zeros(40, 1).long(), False)
    population = Population.create(RewardSpec(1, 1, ()), 2, generator=generator)
    with torch.no_grad():
        population.members["0", "weight"].copy_(torch.tensor([0.5, 2.0]).view(2, 1, 1))
    return population, SimpleNamespace(bank=bank, answers=strict), Fold(0, [], said, strict, [])


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_the_threshold_of_ties_goes_with_the_scale(told, monkeypatch, scale):
    """The member with the right margins serves all, however firmly the set is to be believed.

    Had the threshold stayed, that with a quarter of them would at a scale of 4.
    """
    population, people, fold = told
    monkeypatch.setattr(people_training, "_scale", lambda *_: scale)
    found = as_set(population, alpha=0.5)
    chosen = as_trained("popl", found, people, fold, alpha=0.5).predictors
    assert found.alpha == 0.5 * scale
    again = set_predictors(found, people, fold, alpha=0.5)
    for predictors in (chosen, again):
        prior = predictors["posterior"].log_prior
        assert int(prior.argmax()) == 1
        right = predictors["posterior"].likelihood[[1]]
        assert torch.equal(predictors["single"].likelihood, right)
