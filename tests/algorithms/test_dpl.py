import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from popl_rl.algorithms.dpl import (
    DistributionalReward,
    add_independent,
    categorical_log_preference,
    interpolated_quantile,
    normal_log_preference,
    train_dpl,
)
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons

KINDS = ("mean_variance", "categorical")


def single_steps(state):
    """A bank of segments of one step each, observations ``[N, O]``."""
    rows = torch.arange(len(state)).unsqueeze(1)
    return SegmentBank(state, rows, torch.zeros_like(rows), False)


def preferences_of(preferred, other):
    count = len(preferred)
    return Comparisons(
        torch.as_tensor(preferred), torch.as_tensor(other), torch.arange(count), count
    )


def stateless(*, hidden_context, seed, pairs=2048):
    """The problem of the DPL paper: states U[0, 1] are worth what they are.

    With hidden context, a state from 0.8 up is worth twice that or nothing, as a coin flipped for
    each state decides.
    """
    generator = torch.Generator().manual_seed(seed)
    state = torch.rand(2 * pairs, 1, generator=generator)
    value = state[:, 0].clone()
    if hidden_context:
        coin = torch.randint(2, value.shape, generator=generator)
        value = torch.where(value >= 0.8, 2 * coin * value, value)
    first, second = value.view(-1, 2).unbind(1)
    strict = first != second
    index = torch.arange(2 * pairs).view(-1, 2)[strict]
    side = (second > first)[strict].long().unsqueeze(1)
    preferred, other = index.gather(1, side).squeeze(1), index.gather(1, 1 - side).squeeze(1)
    return single_steps(state), preferences_of(preferred, other)


def linear(weight, bias):
    network = nn.Sequential(nn.Linear(len(weight[0]), len(weight)))
    network.load_state_dict({"0.weight": torch.tensor(weight), "0.bias": torch.tensor(bias)})
    return network.requires_grad_(False)


@pytest.fixture
def hand():
    """Steps A and B of utilities N(1, 2^2) and N(3, 1^2), and the segments AA, AB and BB.

    Standard deviations are 0.01 + softplus(x), and softplus(x) = s for x = ln(e^s - 1).
    """
    wide, narrow = (math.log(math.expm1(s)) for s in (1.99, 0.99))
    network = linear([[1.0, 3.0], [wide, narrow]], [0.0, 0.0])
    bank = SegmentBank(
        torch.eye(2), torch.tensor([[0, 0], [0, 1], [1, 1]]), torch.zeros(3, 2), True
    )
    return DistributionalReward(network, "mean_variance"), bank


@pytest.fixture
def dice():
    """A fair die whose sides are worth 0, 1/5 .. 1, rolled twice for every segment."""
    network = linear([[0.0]] * 6, [0.0] * 6)
    bank = SegmentBank(torch.ones(1, 1), torch.zeros(2, 2).long(), torch.zeros(2, 2), True)
    return DistributionalReward(network, "categorical"), bank


def test_normal_preference_by_hand():
    """Of N(5, 4^2) and N(2, 3^2) the difference is N(3, 5^2), and Phi(3 / 5) = 0.7257469."""
    means, variances = torch.tensor([5.0, 2.0]), torch.tensor([16.0, 9.0])
    forth = normal_log_preference(means[0], variances[0], means[1], variances[1])
    back = normal_log_preference(means[1], variances[1], means[0], variances[0])
    assert [float(forth.exp()), float(back.exp())] == pytest.approx([0.7257469, 0.2742531])


def test_normal_preference_far_out():
    """Where Phi(z) rounds to 0, its logarithm is about -z^2 / 2 - ln(-z sqrt(2 pi))."""
    zero, one = torch.zeros(()), torch.full((), 0.5)
    found = float(normal_log_preference(torch.tensor(-40.0), one, zero, one))
    assert found == pytest.approx(-800 - math.log(40 * math.sqrt(2 * math.pi)), abs=0.01)
    exact = normal_log_preference(one, zero, zero, zero)
    assert float(exact) == 0


def test_categorical_preference_by_hand():
    """With p = (5, 3, 2) / 10 and q = (2, 5, 3) / 10, i > j holds with probability

    3/10 * 2/10 + 2/10 * (2/10 + 5/10) = 0.20, and i = j with 0.10 + 0.15 + 0.06 = 0.31.
    """
    p, q = torch.tensor([0.5, 0.3, 0.2]), torch.tensor([0.2, 0.5, 0.3])
    assert float(categorical_log_preference(p, q).exp()) == pytest.approx(0.355)
    assert float(categorical_log_preference(q, p).exp()) == pytest.approx(0.645)
    sure = torch.eye(3)
    found = categorical_log_preference(sure[:, None].expand(3, 3, 3), sure.expand(3, 3, 3)).exp()
    torch.testing.assert_close(found, torch.ones(3, 3).tril() - torch.eye(3) / 2)


@pytest.mark.parametrize(
    ("probabilities", "expected"),
    [
        ([[1 / 6] * 6] * 2, [n / 36 for n in (1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1)]),
        ([[1 / 2] * 2] * 3, [1 / 8, 3 / 8, 3 / 8, 1 / 8]),
        ([[0.1, 0.9], [0.7, 0.3]], [0.07, 0.66, 0.27]),
        ([[0.2, 0.5, 0.3]], [0.2, 0.5, 0.3]),
    ],
    ids=["two dice", "three coins", "two unfair coins", "one step"],
)
def test_sums_by_hand(probabilities, expected):
    assert add_independent(torch.tensor(probabilities)).tolist() == pytest.approx(
        expected, abs=1e-6
    )


@pytest.mark.parametrize(
    ("risk", "expected"), [(0.1, 0.0), (0.2, 0.5), (0.45, 1.0), (0.85, 2.0), (0.94, 2.3)]
)
def test_quantiles_by_hand(risk, expected):
    """Atoms of mass 0.2, 0.5 and 0.3, each spread over a cell of width 1 around 0, 1 and 2.

    The distribution function is 0.2 at 1/2 and 0.7 at 3/2, so that 0.45 lies in the middle, at 1.
    """
    probabilities = torch.tensor([[0.2, 0.5, 0.3], [0.0, 1.0, 0.0]])
    found = interpolated_quantile(probabilities, risk)
    assert found.tolist() == pytest.approx([expected, 0.5 + risk], abs=1e-5)


def test_quantiles_never_leave_the_atoms_cells():
    """Rounding may leave the last entry of the distribution function below 1."""
    short = torch.full((7,), 1 / 7 - 1e-6)
    assert float(interpolated_quantile(short, 0.9999999)) == pytest.approx(6.5)


def test_normal_segments_by_hand(hand):
    """AA, AB and BB have means 2, 4, 6 and variances 8, 5, 2; Phi^-1(0.01) = -2.3263479.

    The means have variance 8/3 and the variances the mean 5, so that r^2 = (8/3) / (8/3 + 5).
    """
    reward, bank = hand
    assert reward.mean(bank).tolist() == pytest.approx([2, 4, 6])
    assert torch.equal(reward.scores(bank), reward.mean(bank))
    expected = [m - 2.3263479 * v**0.5 for m, v in ((2, 8), (4, 5), (6, 2))]
    assert reward.scores(bank, risk=0.01).tolist() == pytest.approx(expected, abs=1e-5)
    assert reward.scores(bank, risk=0.5).tolist() == pytest.approx([2, 4, 6])
    assert reward.hidden_context(bank) == pytest.approx(8 / 23)
    mean, std = reward.step_mean_std(torch.eye(2))
    assert mean.tolist() == pytest.approx([1, 3])
    assert std.tolist() == pytest.approx([2, 1])


def test_categorical_segments_by_hand(dice):
    """Two dice with sides k/5 have the mean 1; a die has the variance (35/12) / 25.

    The distribution function of their sum is 1/36 half a cell above 0, and 3/36 half a cell above
    the next atom, 1/5: a quantile of 2/36 lies in the middle of that cell, at 1/5.
    """
    reward, bank = dice
    assert reward.mean(bank).tolist() == pytest.approx([1, 1])
    assert reward.scores(bank, risk=2 / 36).tolist() == pytest.approx([1 / 5, 1 / 5], abs=1e-5)
    assert reward.scores(bank, risk=0.5).tolist() == pytest.approx([1, 1], abs=1e-5)
    mean, std = reward.step_mean_std(torch.ones(3, 1))
    assert mean.tolist() == pytest.approx([0.5] * 3)
    assert std.tolist() == pytest.approx([(35 / 12) ** 0.5 / 5] * 3)
    assert reward.hidden_context(bank) == pytest.approx(0)


def distributions(count, atoms, steps, seed):
    generator = torch.Generator().manual_seed(seed)
    logits = 3 * torch.randn(count, steps, atoms, generator=generator, dtype=torch.float64)
    return logits.softmax(-1)


@settings(deadline=None)
@given(st.integers(1, 6), st.integers(2, 12), st.integers(0, 2**32))
def test_one_of_two_is_preferred(steps, atoms, seed):
    one, other = add_independent(distributions(2, atoms, steps, seed).float())
    chance = categorical_log_preference(one, other).exp()
    assert float(chance + categorical_log_preference(other, one).exp()) == pytest.approx(1)
    assert 0 <= float(chance) <= 1 + 1e-6


@settings(deadline=None)
@given(*[st.floats(-50, 50)] * 2, *[st.floats(0.01, 100)] * 2)
def test_one_of_two_normals_is_preferred(mean, other_mean, variance, other_variance):
    one = torch.tensor([mean, variance]).unbind()
    other = torch.tensor([other_mean, other_variance]).unbind()
    chances = normal_log_preference(*one, *other).exp(), normal_log_preference(*other, *one).exp()
    assert float(sum(chances)) == pytest.approx(1, abs=1e-5)


@settings(deadline=None)
@given(st.integers(1, 9), st.integers(2, 12), st.integers(0, 2**32))
def test_means_and_variances_add(steps, atoms, seed):
    (each,) = distributions(1, atoms, steps, seed)
    total = add_independent(each)
    assert len(total) == steps * (atoms - 1) + 1
    assert float(total.sum()) == pytest.approx(1)

    def moments(probabilities):
        value = torch.arange(probabilities.shape[-1], dtype=torch.float64)
        mean = probabilities @ value
        return mean.sum(), (probabilities @ value.square() - mean.square()).sum()

    torch.testing.assert_close(moments(total), moments(each))


@settings(deadline=None)
@given(st.integers(2, 12), st.floats(0.01, 0.99), st.floats(0.01, 0.99), st.integers(0, 2**32))
def test_quantiles_grow_with_risk_and_with_utility(atoms, risk, other, seed):
    ((probabilities,),) = distributions(1, atoms, 1, seed)
    low, high = sorted((risk, other))
    quantile = interpolated_quantile(probabilities, low)
    assert -0.5 <= float(quantile) <= float(interpolated_quantile(probabilities, high)) + 1e-4
    better = torch.cat([probabilities.new_zeros(1), probabilities])
    assert float(interpolated_quantile(better, low)) == pytest.approx(float(quantile) + 1, abs=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_hidden_context_is_detected_and_avoided(kind):
    """Without hidden context r^2 is near 1; with it, high states spread and risk shuns them."""

    def train(*, hidden_context):
        bank, comparisons = stateless(hidden_context=hidden_context, seed=0)
        reward = train_dpl(
            bank,
            comparisons,
            kind=kind,
            hidden=(32, 32),
            steps=200,
            batch_size=128,
            learning_rate=1e-2,
            generator=torch.Generator().manual_seed(0),
        )
        return reward, bank

    clear, bank = train(hidden_context=False)
    assert clear.hidden_context(bank) > 0.93
    order = clear.mean(bank)[bank.observation[:, 0].argsort()]
    assert (order.diff() > 0).float().mean() > 0.95

    reward, bank = train(hidden_context=True)
    assert reward.hidden_context(bank) < 0.6
    state = bank.observation[:, 0]
    std = reward.step_mean_std(bank.observation)[1]
    assert std[state >= 0.82].mean() > 1.5 * std[state < 0.78].mean()

    def rank(score):
        return score.argsort().argsort()[state >= 0.82].float().mean() / len(score)

    assert rank(reward.scores(bank, risk=0.1)) < rank(reward.mean(bank)) - 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_segments_of_several_steps_are_learnt(bank, kind, generator):
    """Raters who want to be at the right end of the line of five cells."""
    place = bank.observation[bank.row].argmax(-1).float().sum(1)
    better, worse = (place.unsqueeze(1) > place).nonzero(as_tuple=True)
    reward = train_dpl(
        bank,
        preferences_of(better, worse),
        kind=kind,
        hidden=(8,),
        steps=100,
        batch_size=64,
        learning_rate=2e-2,
        generator=generator,
    )
    for score in (reward.mean(bank), reward.scores(bank), reward.scores(bank, risk=0.2)):
        assert score.shape == (len(bank),)
        assert (score[better] > score[worse]).float().mean() > 0.95
    mean, _ = reward.step_mean_std(torch.eye(5))
    assert (mean.diff() > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_repeated_observations_may_be_stored_once_or_often(bank, kind):
    """The same segments with a row of observations for each step give the same model."""
    assert bank.is_shared
    apart = SegmentBank(
        bank.observation[bank.row.flatten()],
        torch.arange(bank.row.numel()).view_as(bank.row),
        bank.action,
        False,
    )
    comparisons = preferences_of([0, 1, 2, 3], [4, 5, 6, 7])

    def score(bank):
        generator = torch.Generator().manual_seed(0)
        reward = train_dpl(bank, comparisons, kind=kind, steps=5, generator=generator)
        scores = torch.stack([reward.mean(bank), reward.scores(bank, risk=0.1)])
        # Answers do not fix where the scale's zero is: it drifts as rounding has it.
        return scores - scores.mean(1, keepdim=True)

    torch.testing.assert_close(score(bank), score(apart), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_scores_do_not_depend_on_the_chunks(bank, kind, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    comparisons = preferences_of([0], [1])
    reward = train_dpl(bank, comparisons, kind=kind, steps=1, generator=generator)
    whole = reward.scores(bank, risk=0.1)
    monkeypatch.setattr("popl_rl.algorithms.dpl._CELLS", 1)
    torch.testing.assert_close(reward.scores(bank, risk=0.1), whole)


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_decides_everything(bank, comparisons, kind):
    def weights(seed):
        generator = torch.Generator().manual_seed(seed)
        reward = train_dpl(bank, comparisons, kind=kind, steps=3, batch_size=4, generator=generator)
        return list(reward.network.state_dict().values())

    torch.manual_seed(5)
    once = weights(0)
    torch.manual_seed(6)
    assert all(map(torch.equal, once, weights(0)))
    assert not any(map(torch.equal, once, weights(1)))


def test_actions_and_cases_are_not_looked_at(bank, comparisons):
    def weights(bank, comparisons):
        generator = torch.Generator().manual_seed(0)
        reward = train_dpl(bank, comparisons, kind="categorical", steps=2, generator=generator)
        return list(reward.network.state_dict().values())

    nan = torch.full_like(bank.action, math.nan, dtype=torch.float32)
    other = weights(replace(bank, action=nan), replace(comparisons, case=nan[:, 0]))
    assert all(map(torch.equal, weights(bank, comparisons), other))


@pytest.mark.parametrize(("steps", "told"), [(1, [1]), (50, [50]), (120, [50, 100, 120])])
def test_progress_is_told(bank, comparisons, generator, steps, told):
    seen = []
    train_dpl(
        bank,
        comparisons,
        kind="mean_variance",
        hidden=(),
        steps=steps,
        batch_size=1,
        generator=generator,
        progress=seen.append,
    )
    assert seen == told


def test_the_order_of_steps_teaches_nothing(generator):
    """The sums of A, A, B and A, B, A are equal; those of A, A, B and A, B, B are not."""
    observation = torch.tensor([[0.0], [0.0], [1.0], [0.0], [1.0], [0.0], [0.0], [1.0], [1.0]])
    bank = SegmentBank(observation, torch.arange(9).view(3, 3), torch.zeros(3, 3), False)
    with pytest.raises(ValueError, match="in all 1 both sides show the same: nothing tells"):
        train_dpl(bank, preferences_of([0], [1]), kind="mean_variance", generator=generator)
    train_dpl(bank, preferences_of([0], [2]), kind="mean_variance", steps=1, generator=generator)


@pytest.mark.parametrize("kind", KINDS)
def test_a_loss_that_is_no_number_is_reported(kind, generator):
    state = torch.tensor([[0.0], [math.nan], [1.0]])
    message = r"the loss must be finite, got nan by step 5; .* lower learning_rate \(0.002\)"
    with pytest.raises(ValueError, match=message):
        train_dpl(
            single_steps(state),
            preferences_of([0, 1], [2, 2]),
            kind=kind,
            steps=5,
            generator=generator,
        )


@pytest.mark.parametrize("risk", [0.0, 1.0, -0.1, math.nan])
def test_risks_outside_the_unit_interval_are_refused(hand, risk):
    reward, bank = hand
    with pytest.raises(ValueError, match="risk must be strictly between 0 and 1, got"):
        reward.scores(bank, risk=risk)
