import math

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.algorithms.brex import Chain, brex

CONTRAST = torch.tensor([[1.0, 0.5, -0.2], [0.3, -1.0, 0.4]])


@pytest.fixture(scope="module")
def stateless():
    """2048 comparisons of the stateless problem, by one hidden group or the other.

    States are U[0, 1] and worth what they are, but from 0.8 up twice that to one group and nothing
    to the other.

    Returns:
        The comparisons' contrasts, and the share of strict pairs that each group ranks like weights
        ``[K, 512]``, ``[2, K]``.
    """
    generator = torch.Generator().manual_seed(0)
    slope, offset = 2 * torch.rand(2, 512, generator=generator) - 1

    def features(state):
        return F.relu(state[..., None] * slope + offset)

    def segment_utility(state, group):
        return torch.where(state >= 0.8, 2.0 * group * state, state)

    state = torch.rand(2048, 2, generator=generator)
    group = torch.randint(2, (2048, 1), generator=generator)
    value = segment_utility(state, group)
    first, second = features(state).unbind(1)
    side = (value[:, 0] - value[:, 1]).sign().unsqueeze(-1)
    contrast = ((first - second) * side)[(side != 0).squeeze(-1)]

    def accuracy(weights):
        grid = (torch.arange(100) + 0.5) / 100
        reward = weights @ features(grid).T
        found = []
        for number in (0, 1):
            value = segment_utility(grid, number)
            better, worse = (value.unsqueeze(1) > value).nonzero(as_tuple=True)
            found.append((reward[:, better] > reward[:, worse]).float().mean(1))
        return torch.stack(found)

    return contrast, accuracy


def test_samples_follow_the_posterior(generator):
    """Of a point uniform on the sphere, each coordinate is uniform on [-1, 1] (Archimedes).

    With M comparisons of contrast (c, 0, 0), the first coordinate t has the density
    sigmoid(beta c t)^M, up to a constant; the others have mean 0.
    """
    count, confidence, length = 4, 2.0, 1.5
    t = torch.linspace(-1, 1, 10_001, dtype=torch.float64)
    density = torch.sigmoid(confidence * length * t) ** count
    density /= density.sum()
    expected = float(density @ t)
    spread = float(density @ t.square()) - expected**2
    contrast = torch.tensor([[length, 0.0, 0.0]]).expand(count, 3)
    chain = brex(
        contrast, steps=6000, confidence=confidence, step_std=1.0, keep=6000, generator=generator
    )
    t = chain.weights[:, 0]
    assert float(t.mean()) == pytest.approx(expected, abs=0.03)
    assert float(t.var()) == pytest.approx(spread, abs=0.02)
    assert chain.weights[:, 1:].mean(0).tolist() == pytest.approx([0, 0], abs=0.05)


@settings(max_examples=20, deadline=None)
@given(
    st.integers(1, 5),
    st.integers(1, 4),
    st.floats(0.01, 3),
    st.floats(0.1, 5),
    st.integers(0, 2**32),
)
def test_samples_are_unit_vectors_with_their_likelihood(pairs, width, std, confidence, seed):
    generator = torch.Generator().manual_seed(seed)
    contrast = torch.randn(pairs, width, generator=generator)
    chain = brex(
        contrast, steps=220, keep=110, step_std=std, confidence=confidence, generator=generator
    )
    assert (len(chain), chain.weights.dtype) == (110, torch.float32)
    torch.testing.assert_close(chain.weights.norm(dim=1), torch.ones(110))
    margin = chain.weights.double() @ contrast.double().T
    expected = F.logsigmoid(confidence * margin).sum(1)
    torch.testing.assert_close(chain.log_likelihood, expected, atol=1e-5, rtol=1e-5)


def test_samples_repeat_where_proposals_were_rejected(generator):
    chain = brex(5 * CONTRAST, steps=500, keep=500, step_std=1.0, generator=generator)
    moved = (chain.weights[1:] != chain.weights[:-1]).any(1)
    assert torch.equal(moved, chain.log_likelihood.diff() != 0)
    # Whether the first proposal was accepted cannot be seen: the start is not a sample.
    assert round(500 * chain.acceptance) - int(moved.sum()) in (0, 1)
    assert 0.1 < chain.acceptance < 0.9


@pytest.mark.parametrize(
    ("burn_in", "keep", "kept"),
    [
        (0, 10, range(10)),
        (4, 3, [5, 7, 9]),
        (0, 3, [2, 5, 9]),
        (9, 1, [9]),
        (7, 2, [7, 9]),
        (0, 1, [9]),
    ],
)
def test_samples_are_evenly_spaced_after_burn_in(burn_in, keep, kept):
    """Of s steps after burn-in, sample k = 1..K is the state after floor(k s / K) of them."""

    def sample(burn_in, keep):
        generator = torch.Generator().manual_seed(3)
        return brex(
            CONTRAST, steps=10, burn_in=burn_in, keep=keep, step_std=0.3, generator=generator
        )

    everything, some = sample(0, 10), sample(burn_in, keep)
    assert torch.equal(some.weights, everything.weights[list(kept)])
    assert torch.equal(some.log_likelihood, everything.log_likelihood[list(kept)])
    assert some.acceptance == everything.acceptance


def test_mean_and_map_by_hand():
    """The mean of (1, 0), (0, 1) and (0, 1) is (1, 2) / 3, of length sqrt(5) / 3."""
    weights = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    chain = Chain(weights, torch.tensor([-1.0, -2.0, -3.0]), 0.5)
    assert chain.mean.tolist() == pytest.approx([5**-0.5, 2 * 5**-0.5])
    assert chain.map.tolist() == [1, 0]


def test_the_seed_decides_everything():
    def sample(seed):
        return brex(CONTRAST, steps=150, keep=150, generator=torch.Generator().manual_seed(seed))

    once, again, other = sample(0), sample(0), sample(1)
    assert torch.equal(once.weights, again.weights)
    assert torch.equal(once.log_likelihood, again.log_likelihood)
    assert not torch.equal(once.weights, other.weights)


def test_hidden_groups_collapse_onto_one(stateless):
    """Any utility that grows with the state ranks all pairs of group 1 correctly.

    Of group 0's 80 * 79 / 2 + 80 * 20 = 4760 strict pairs on the grid of 100 states, it gets the
    3160 right that lie below 0.8: 66.4 % (66.7 % of random pairs).
    """
    contrast, accuracy = stateless
    chain = brex(
        contrast, steps=4000, burn_in=1000, keep=100, generator=torch.Generator().manual_seed(0)
    )
    single = accuracy(torch.stack([chain.mean, chain.map]))
    assert single[0].tolist() == pytest.approx([3160 / 4760] * 2, abs=0.005)
    assert single[1].min() > 0.995
    samples = accuracy(chain.weights)
    assert samples[0].max() < 0.68
    assert samples[1].min() > 0.98
    assert 0.2 < chain.acceptance < 0.5


def test_the_published_step_is_hardly_ever_accepted(stateless):
    contrast, accuracy = stateless
    chain = brex(
        contrast, steps=2000, step_std=0.1, keep=100, generator=torch.Generator().manual_seed(0)
    )
    assert 0 < chain.acceptance < 0.02
    assert accuracy(chain.map[None]).squeeze(1).tolist() == pytest.approx(
        [3160 / 4760, 1], abs=0.01
    )


@pytest.mark.parametrize(
    ("contrast", "message"),
    [
        (torch.ones(3), r"contrast must hold .* \[M, F\], got shape \(3,\)"),
        (torch.ones(2, 3, 4), r"contrast must hold .*, got shape \(2, 3, 4\)"),
        (torch.ones(0, 3), r"contrast must hold at least one comparison .*, got shape \(0, 3\)"),
        (torch.ones(3, 0), r"contrast must hold .* one feature, .*, got shape \(3, 0\)"),
        (
            torch.tensor([[1.0, math.nan], [math.inf, 1.0]]),
            "contrast must be finite, got 2 NaN or infinite values; look at the features",
        ),
        (
            torch.zeros(4, 3),
            "contrast must tell segments apart, got zeros only: .* use features that vary",
        ),
    ],
)
def test_contrasts_that_teach_nothing_are_refused(contrast, message, generator):
    with pytest.raises(ValueError, match=message):
        brex(contrast, generator=generator)


def test_whole_numbers_are_refused(generator):
    with pytest.raises(TypeError, match=r"contrast must be floating point, got torch.int64"):
        brex(torch.ones(2, 2, dtype=torch.long), generator=generator)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"step_std": 0.0}, "step_std must be positive and finite, got 0.0"),
        ({"step_std": math.nan}, "step_std must be positive and finite, got nan"),
        ({"confidence": -1.0}, "confidence must be positive and finite, got -1.0"),
        ({"confidence": math.inf}, "confidence must be positive and finite, got inf"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"burn_in": -1}, "burn_in must be at least 0, got -1"),
        ({"keep": 0}, "keep must be at least 1, got 0"),
        (
            {"steps": 10, "burn_in": 10, "keep": 1},
            "burn_in must be less than steps, got 10 of 10; take more steps",
        ),
        (
            {"steps": 10, "burn_in": 4, "keep": 7},
            "keep must be at most the 6 steps after burn-in, got 7; take more steps or keep fewer",
        ),
    ],
)
def test_bad_settings_are_refused(settings, message, generator):
    with pytest.raises(ValueError, match=message):
        brex(CONTRAST, **settings, generator=generator)


def test_a_likelihood_that_overflows_is_reported(generator):
    huge = 1e300 * CONTRAST.double()
    with pytest.raises(ValueError, match=r"log-likelihood must be finite, got -inf at step \d+; "):
        brex(huge, confidence=1e10, generator=generator)


def test_pairs_of_segments_are_their_contrasts(generator, monkeypatch):
    """The same chain, from features of segments and who was preferred to whom."""
    monkeypatch.setattr("popl_rl.algorithms.brex._PAIRS", 50)
    features = torch.randn(20, 4, generator=generator)
    preferred, other = torch.randint(20, (2, 120), generator=generator)
    chains = [
        brex(
            features[preferred] - features[other],
            steps=400,
            keep=40,
            generator=torch.Generator().manual_seed(3),
        ),
        brex(
            features,
            pairs=(preferred, other),
            steps=400,
            keep=40,
            generator=torch.Generator().manual_seed(3),
        ),
    ]
    assert 0 < chains[0].acceptance < 1
    assert chains[0].acceptance == chains[1].acceptance
    torch.testing.assert_close(chains[0].weights, chains[1].weights)
    torch.testing.assert_close(chains[0].log_likelihood, chains[1].log_likelihood)
