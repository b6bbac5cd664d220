"""What is hidden stays hidden: nothing that is learnt depends on groups or utilities."""

from functools import partial

import pytest
import torch

from popl_rl.algorithms.mixture_population import MixtureSettings
from popl_rl.config import MethodConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.experiments.builders import build_popl, final_set
from popl_rl.keys import GROUP, HIDDEN_KEYS, LEARNER_KEYS, UTILITY
from popl_rl.models.policies import PolicySpec

METHODS = {
    "gradient, rater cases": {"cases": "rater", "variation": "gradient"},
    "gradient, preference cases": {"cases": "preference", "variation": "gradient"},
    "gaussian, rater cases": {"cases": "rater", "variation": "gaussian", "evolve": "head"},
    "gaussian, preference cases": {
        "cases": "preference",
        "variation": "gaussian",
        "evolve": "head",
    },
    "teams": {"cases": "preference", "variation": "teams", "teams": 3, "team_generations": 3},
    "multi_cpl": {"algorithm": "multi_cpl"},
    "em": {"algorithm": "em"},
    "vpl": {"algorithm": "vpl"},
    "nsga2": {"selection": "nsga2"},
}


def garbage(preferences, segments):
    """Groups that do not exist, utilities that are no numbers."""
    preferences[GROUP] = torch.full_like(preferences[GROUP], -(2**62))
    preferences[UTILITY] = torch.full_like(preferences[UTILITY], torch.nan)
    segments["reward"] = torch.full_like(segments["reward"], torch.nan)
    for name in list(segments["info"].keys()):
        segments["info", name] = torch.full_like(segments["info", name], -(2**62))


def permuted(preferences, segments):
    """Every preference gets another one's group and utilities."""
    order = torch.randperm(len(preferences), generator=torch.Generator().manual_seed(1))
    preferences[GROUP] = preferences[GROUP][order]
    preferences[UTILITY] = preferences[UTILITY][order].flip(1)


def absent(preferences, segments):
    """A learner needs neither hidden keys, nor rewards, nor infos."""
    del preferences["hidden"], segments["reward"], segments["info"]


def learn(preferences, segments, **method):
    """Train for three generations; return all scalars and the whole state."""
    config = MethodConfig(
        members=4,
        generations=3,
        hidden=[6],
        steps=2,
        batch_size=16,
        warm_up=3,
        polish_steps=20,
        **method,
    )
    popl = build_popl(
        config,
        PolicySpec(5, 2, True, (6,)),
        SegmentBank.from_segments(segments),
        Comparisons.from_preferences(preferences, cases=config.cases),
        generator=torch.Generator().manual_seed(0),
    )
    metrics = [popl.step() for _ in range(3)]
    policies = final_set(popl)
    members = list(policies.population.state_dict().values())
    return metrics, policies.origin, members, tensors_of(popl.state_dict())


def tensors_of(state):
    """Every tensor of a nested state."""
    if isinstance(state, torch.Tensor):
        return [state.clone()]
    if isinstance(state, dict):
        state = list(state.values())
    if isinstance(state, (list, tuple)):
        return [tensor for value in state for tensor in tensors_of(value)]
    return []


def test_poison_reaches_every_hidden_key(preferences, segments):
    clean = preferences.clone()
    garbage(preferences, segments)
    for key in HIDDEN_KEYS:
        assert not torch.equal(preferences[key], clean[key])
    for key in LEARNER_KEYS:
        assert torch.equal(preferences[key], clean[key])
    assert set(preferences.keys(True, True)) == {*HIDDEN_KEYS, *LEARNER_KEYS}


@pytest.mark.parametrize("method", METHODS)
def test_learning_is_the_same_to_the_bit_whatever_is_hidden(
    monkeypatch, preferences, segments, method
):
    quick = partial(MixtureSettings, steps=2, batch_size=32, first_selection=1, polish_steps=4)
    monkeypatch.setattr("popl_rl.experiments.builders.MixtureSettings", quick)
    metrics, origin, members, state = learn(preferences, segments, **METHODS[method])
    assert len(state) >= 3
    for poison in (garbage, permuted, absent):
        some, steps = preferences.clone(), segments.clone()
        poison(some, steps)
        result = learn(some, steps, **METHODS[method])
        assert result[:2] == (metrics, origin), poison.__name__
        for expected, found in zip((members, state), result[2:], strict=True):
            assert len(expected) == len(found)
            assert all(map(torch.equal, expected, found)), poison.__name__


def test_what_is_not_hidden_does_matter(preferences, segments):
    """Otherwise the tests above would say nothing."""
    _, _, members, _ = learn(preferences, segments, cases="rater", variation="gradient")
    preferences["answer"] = torch.where(
        preferences["answer"] <= 1, 1 - preferences["answer"], preferences["answer"]
    )
    _, _, other, _ = learn(preferences, segments, cases="rater", variation="gradient")
    assert not any(
        one.shape == two.shape and torch.equal(one, two)
        for one, two in zip(members, other, strict=True)
    )
