"""What is hidden stays hidden: nothing that is learnt depends on groups or utilities."""

import pytest
import torch

from popl_rl.data.comparisons import Comparisons
from popl_rl.keys import GROUP, HIDDEN_KEYS, LEARNER_KEYS, UTILITY
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.style_codes import train_clone

EM = {"factory": "popl_rl.algorithms.em:EM", "reads": ["training", "em"]}
VPL = {"factory": "popl_rl.algorithms.vpl:VPL", "reads": ["training", "vpl"]}
CPL = {"factory": "popl_rl.algorithms.multi_cpl:MultiCPL", "reads": ["training"]}
GAUSSIAN = {"popl__variation": "gaussian", "evolve": "head"}
METHODS = {
    "gradient, rater cases": {},
    "gradient, preference cases": {"cases": "preference", "popl__variation": "gradient"},
    "gaussian, rater cases": GAUSSIAN,
    "gaussian, preference cases": {"cases": "preference", **GAUSSIAN},
    "heads": {"evolve": "head"},
    "style codes": {"evolve": "code"},
    "reward functions": {"learns": "reward"},
    "mixtures": {"cases": "preference"},
    "multi_cpl": CPL,
    "em": EM,
    "em of preferences": {"cases": "preference", **EM},
    "em of style codes": {"evolve": "code", **EM},
    "em of reward functions": {"learns": "reward", **EM},
    "vpl": VPL,
    "lore": {"factory": "popl_rl.algorithms.lore:LoRe", "reads": ["training", "lore"]},
    "kmeans": {
        "factory": "popl_rl.algorithms.kmeans:KMeans",
        "reads": ["training", "popl", "kmeans"],
    },
    "nsga2": {"popl__selection": "nsga2"},
}
#: Short, whatever the method.
QUICK = {
    "members": 4,
    "generations": 3,
    "training__steps": 6,
    "training__batch_size": 16,
    "popl__warm_up": 3,
    "popl__pooled_steps": 4,
    "popl__specialist_steps": 3,
    "refinement__steps": 20,
    "mixture__mixtures": 3,
    "mixture__generations": 3,
    "mixture__steps": 2,
    "mixture__first_selection": 1,
    "mixture__final_steps": 4,
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


def learn(learner, preferences, segments, **method):
    """Train for three generations; return all scalars, the set, and the whole state."""
    kind = RewardSpec if method.get("learns") == "reward" else PolicySpec
    spec = kind(5, 2, hidden=(6,)) if kind is RewardSpec else PolicySpec(5, 2, True, (6,))
    bank = spec.bank(segments)
    cases = method.get("cases", "rater")
    comparisons = Comparisons.from_preferences(preferences, cases=cases)
    clone = None
    if method.get("evolve") == "code":
        generator = torch.Generator().manual_seed(1)
        clone = train_clone(spec, bank, steps=20, batch_size=16, generator=generator)
    popl = learner(spec, bank, comparisons, clone=clone, **QUICK, **method)
    metrics = [popl.step() for _ in range(3)]
    policies = popl.result()
    members = [*policies.population.plain().state_dict().values(), torch.tensor(policies.alpha)]
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
def test_learning_is_the_same_to_the_bit_whatever_is_hidden(learner, preferences, segments, method):
    metrics, origin, members, state = learn(learner, preferences, segments, **METHODS[method])
    assert len(state) >= 3
    for poison in (garbage, permuted, absent):
        some, steps = preferences.clone(), segments.clone()
        poison(some, steps)
        result = learn(learner, some, steps, **METHODS[method])
        assert result[:2] == (metrics, origin), poison.__name__
        for expected, found in zip((members, state), result[2:], strict=True):
            assert len(expected) == len(found)
            assert all(map(torch.equal, expected, found)), poison.__name__


def test_what_is_not_hidden_does_matter(learner, preferences, segments):
    """Otherwise the tests above would say nothing."""
    _, _, members, _ = learn(learner, preferences, segments)
    preferences["answer"] = torch.where(
        preferences["answer"] <= 1, 1 - preferences["answer"], preferences["answer"]
    )
    _, _, other, _ = learn(learner, preferences, segments)
    assert not any(
        one.shape == two.shape and torch.equal(one, two)
        for one, two in zip(members[:-1], other[:-1], strict=True)
    )
