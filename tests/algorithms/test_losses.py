import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn

from popl_rl.algorithms.draws import by_comparison
from popl_rl.algorithms.losses import (
    CPLLoss,
    answer_losses,
    cloning_weight,
    cpl_loss,
    descend,
)
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.schedules import linear_decay
from popl_rl.models.scoring import segment_scores


@pytest.fixture
def hand():
    """One policy, two segments of two steps, observations A = (1, 0) and B = (0, 1).

    Action 0 has probability 1/2 in A (logits 0, 0) and 3/4 in B (logits ln 3, 0). Both segments
    see A, then B; the first takes action 0 twice, the second action 1 twice.
    """
    network = nn.Sequential(nn.Linear(2, 2))
    network.load_state_dict(
        {"0.weight": torch.tensor([[0.0, math.log(3)], [0.0, 0.0]]), "0.bias": torch.zeros(2)}
    )
    population = Population([network], PolicySpec(2, 2, True, ()))
    bank = SegmentBank(
        torch.eye(2), torch.tensor([[0, 1], [0, 1]]), torch.tensor([[0, 0], [1, 1]]), True
    )
    return population, bank


def batch_of(preferred, other):
    return TensorDict({"preferred": torch.tensor(preferred), "other": torch.tensor(other)}, [])


@pytest.mark.parametrize(
    ("alpha", "conservatism", "discount", "expected"),
    [
        (1.0, 1.0, 1.0, math.log(4 / 3)),
        (0.5, 1.0, 1.0, math.log(1 + 3**-0.5)),
        (0.5, 0.9, 1.0, math.log(1 + (1 / 8) ** 0.45 * (3 / 8) ** -0.5)),
        (1.0, 1.0, 0.5, math.log(1 + 3**-0.5)),
        (1.0, 0.5, 0.5, math.log(1 + (1 / 4) ** 0.5 / (3 / 16) ** 0.5)),
    ],
)
def test_loss_by_hand(hand, alpha, conservatism, discount, expected):
    """The loss is ln(1 + exp(lambda S_1 - S_0)) with scores S = alpha ln(p_0 p_1^gamma).

    With gamma = 1 they are alpha ln(3/8) and alpha ln(1/8); with gamma = 1/2, alpha ln(1/2
    sqrt(3/4)) = alpha ln(sqrt(3/16)) and alpha ln(1/2 sqrt(1/4)) = alpha ln(1/4).

    - alpha 1, lambda 1, gamma 1: ln(1 + (1/8) / (3/8)) = ln(4/3)
    - alpha 1/2: ln(1 + sqrt(1/3))
    - alpha 1/2, lambda 9/10: ln(1 + (1/8)^(9/20) / (3/8)^(1/2))
    - gamma 1/2: ln(1 + (1/4) / sqrt(3/16)) = ln(1 + 1 / sqrt(3))
    - gamma 1/2, lambda 1/2: ln(1 + sqrt(1/4) / sqrt(3/16))
    """
    loss = CPLLoss(*hand, alpha=alpha, conservatism=conservatism, discount=discount)
    out = loss(batch_of([[0]], [[1]]))
    assert float(out["loss_cpl"].detach()) == pytest.approx(expected, rel=1e-5)
    assert out["accuracy"].tolist() == [1.0]


def test_cloning_by_hand(hand):
    """A step of both segments has the mean log-likelihood (ln(3/8) + ln(1/8)) / 4, at any alpha."""
    mean = (math.log(3 / 8) + math.log(1 / 8)) / 4
    for alpha in (1.0, 0.5):
        with_bc, without = CPLLoss(*hand, alpha=alpha, bc=3.0), CPLLoss(*hand, alpha=alpha)
        batch = batch_of([[0]], [[1]])
        with pytest.raises(ValueError, match="num_answers must be set where bc is positive"):
            with_bc(batch)
        with_bc.num_answers = 1
        added = with_bc(batch)["loss_cpl"] - without(batch)["loss_cpl"]
        assert float(added.detach()) == pytest.approx(-3.0 * mean, rel=1e-5)
        # Beside 12 answers, what weighs 3 of them has a share of a quarter.
        with_bc.num_answers = torch.tensor([12.0])
        added = with_bc(batch)["loss_cpl"] - without(batch)["loss_cpl"]
        assert float(added.detach()) == pytest.approx(-mean / 4, rel=1e-5)


def test_the_more_answers_the_less_cloning(hand):
    """Members that learn from 8, from 2 and from no answers; the last counts as one."""
    bank, answers = hand[1], torch.tensor([8.0, 2.0, 0.0])
    found = cloning_weight(4.0, answers, alpha=0.5, bank=bank)
    torch.testing.assert_close(found, torch.tensor([[0.5], [2.0], [4.0]]))
    assert cloning_weight(4.0, 8, alpha=0.5, bank=bank) == 0.5
    assert cloning_weight(0.0, answers, alpha=0.5, bank=bank) == 0.0


def test_descent_tells_the_loss_how_many_answers_there_are(hand, generator):
    """Of three answers the member learns from the first fully and from the last by half."""
    loss = CPLLoss(*hand, bc=1.0)
    rows = torch.tensor([0, 0, 0])
    comparisons = Comparisons(rows, rows + 1, rows, 1)
    optimizer = torch.optim.Adam(hand[0].members.parameters())
    draws = by_comparison(comparisons, torch.tensor([[1.0, 0.0, 0.5]]), least=0.0)
    how = {"steps": 1, "batch_size": 4, "generator": generator}
    descend(loss, optimizer, comparisons, draws=draws, **how)
    torch.testing.assert_close(loss.num_answers, torch.tensor([1.5]))
    descend(loss, optimizer, comparisons, **how)
    torch.testing.assert_close(loss.num_answers, torch.tensor([3.0]))


def test_scores_by_hand(hand):
    """alpha = 1/2 and gamma = 1: ln(3/8) / 2 and ln(1/8) / 2."""
    scores = CPLLoss(*hand, alpha=0.5).scores(torch.tensor([[0, 1, 0]]))
    expected = torch.tensor([[3 / 8, 1 / 8, 3 / 8]]).log() / 2
    torch.testing.assert_close(scores, expected)


def test_a_tie_is_not_right_and_losses_are_means_summed_over_members(hand):
    """One pair is a tie of the first segment with itself: loss ln 2; the other costs ln(4/3).

    Two equal members: twice the mean of the two. Ranked right: one of two.
    """
    population, bank = hand
    loss = CPLLoss(population.subset([0, 0]), bank, alpha=1.0, conservatism=1.0)
    out = loss(batch_of([[0, 0]] * 2, [[0, 1]] * 2))
    assert float(out["loss_cpl"].detach()) == pytest.approx(math.log(2) + math.log(4 / 3), rel=1e-5)
    assert out["accuracy"].tolist() == [0.5, 0.5]
    assert not out["accuracy"].requires_grad


@pytest.mark.parametrize("conservatism", [1.0, 0.5])
def test_the_loss_of_scores(conservatism):
    """-log sigmoid(S+ - lambda S-) with S+ = 1 and S- = -2: ln(1 + exp(-2 lambda - 1))."""
    loss = cpl_loss(torch.tensor([1.0]), torch.tensor([-2.0]), conservatism=conservatism)
    assert float(loss) == pytest.approx(math.log(1 + math.exp(-2 * conservatism - 1)))
    assert bool(cpl_loss(torch.tensor(-1e4), torch.tensor(1e4)).isfinite())


@given(
    seed=st.integers(0, 2**31),
    discrete=st.booleans(),
    evolve=st.sampled_from(["all", "head"]),
    hidden=st.sampled_from([(), (4,)]),
    members=st.integers(1, 3),
    pairs=st.integers(1, 4),
    steps=st.integers(1, 3),
)
@settings(max_examples=30, deadline=None)
def test_scores_agree_with_segment_scores_shared_or_not(
    seed, discrete, evolve, hidden, members, pairs, steps
):
    generator = torch.Generator().manual_seed(seed)
    spec = PolicySpec(2, 3, discrete, hidden)
    population = Population.create(spec, members, evolve=evolve, generator=generator)
    observation = torch.randn(3, 2, generator=generator)
    row = torch.randint(3, (5, steps), generator=generator)
    if discrete:
        action = torch.randint(3, row.shape, generator=generator)
    else:
        action = torch.randn(*row.shape, 3, generator=generator)
    shared = SegmentBank(observation, row, action, True)
    plain = SegmentBank(
        observation[row].flatten(0, 1), torch.arange(row.numel()).view(row.shape), action, False
    )
    segment = torch.randint(5, (members, pairs), generator=generator)
    whole = segment_scores(population, plain, alpha=0.7, discount=0.8)
    gradients = []
    for bank in (shared, plain):
        loss = CPLLoss(population, bank, alpha=0.7, discount=0.8)
        scores = loss.scores(segment)
        torch.testing.assert_close(scores.detach(), whole.gather(1, segment), atol=1e-5, rtol=1e-5)
        population.zero_grad()
        scores.square().sum().backward()
        gradients.append([value.grad.clone() for value in population.members.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


def test_a_lone_batch_of_shared_segments_can_be_smaller_than_the_table(bank, generator):
    """5 observations, one pair of 4 steps a side: 8 steps use the table; one segment's 4 do not."""
    population = Population.create(PolicySpec(5, 2, True, (3,)), 2, generator=generator)
    loss = CPLLoss(population, bank)
    one = torch.tensor([[0], [1]])
    both = torch.tensor([[0, 2], [1, 2]])
    torch.testing.assert_close(loss.scores(one), loss.scores(both)[:, :1])


def train(population, bank, batches):
    loss = CPLLoss(population, bank)
    optimizer = torch.optim.Adam(population.members.parameters(), lr=1e-2)
    for batch in batches:
        optimizer.zero_grad()
        loss(batch)["loss_cpl"].backward()
        optimizer.step()
    return list(population.members.data.values(True, True))


@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize("discrete", [True, False])
def test_members_learn_independently(generator, evolve, discrete):
    """Two members trained together end where each ends when trained alone on its batches."""
    spec = PolicySpec(3, 2, discrete, (6,))
    population = Population.create(spec, 2, evolve=evolve, generator=generator)
    if discrete:
        action = torch.randint(2, (9, 4), generator=generator)
    else:
        action = torch.randn(9, 4, 2, generator=generator)
    bank = SegmentBank(
        torch.randn(36, 3, generator=generator), torch.arange(36).view(9, 4), action, False
    )
    batches = []
    for _ in range(20):
        rows = torch.randint(9, (2, 2, 8), generator=generator)
        batches.append(TensorDict({"preferred": rows[0], "other": rows[1]}, [2, 8]))
    alone = [
        train(population.subset([n]), bank, [batch[n : n + 1] for batch in batches])
        for n in range(2)
    ]
    start = [value.clone() for value in population.members.data.values(True, True)]
    together = train(population, bank, batches)
    for first, second, both, before in zip(*alone, together, start, strict=True):
        torch.testing.assert_close(torch.cat([first, second]), both, atol=1e-5, rtol=1e-4)
        assert not torch.allclose(both, before, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alpha": 0.0}, "alpha must be positive, got 0.0"),
        ({"alpha": math.nan}, "alpha must be positive, got nan"),
        ({"conservatism": 0.0}, r"conservatism must be in \(0, 1\], got 0.0"),
        ({"conservatism": 1.1}, r"conservatism must be in \(0, 1\], got 1.1"),
        ({"discount": 0.0}, r"discount must be in \(0, 1\], got 0.0"),
        ({"bc": -0.1}, "bc must be at least 0, got -0.1"),
        ({"discount": 1.5}, r"discount must be in \(0, 1\], got 1.5"),
    ],
)
def test_the_loss_refuses(hand, change, message):
    with pytest.raises(ValueError, match=message):
        CPLLoss(*hand, **change)


def test_keys_are_declared(hand):
    loss = CPLLoss(*hand)
    out = loss(batch_of([[0]], [[1]]))
    assert set(out.keys()) == set(loss.out_keys)
    assert loss.in_keys == ["preferred", "other"]


def test_a_ranking_is_cloned_by_the_mean_of_its_segments():
    # 0 > 1 > 2: a stage of two comparisons, with scores ln 6, ln 3 and 0, and one of one.
    data = {
        "pair": [[0, 1], [0, 2], [1, 2]],
        "answer": [0] * 3,
        "rater": [0] * 3,
        "ranking": [0] * 3,
    }
    data = TensorDict({name: torch.tensor(value) for name, value in data.items()}, [3])
    said = Comparisons.from_preferences(data, cases="rater")
    index = torch.tensor([0, 2])
    rows = said.together(index)
    score = torch.tensor([[math.log(6), math.log(3), 0.0]], requires_grad=True)
    losses = answer_losses(score[:, said.preferred[rows]], score[:, said.other[rows]], said, index)
    assert losses[0].tolist() == pytest.approx([-math.log(6 / 10), -math.log(3 / 4)])
    cloned = answer_losses(
        score[:, said.preferred[rows]], score[:, said.other[rows]], said, index, cloning=0.1
    )
    (pull,) = torch.autograd.grad((losses - cloned).sum() / 0.1, score)
    assert pull[0].tolist() == pytest.approx([1 / 2, 1 / 4 + 1 / 2, 1 / 4 + 1 / 2], abs=1e-5)


@pytest.fixture
def population(generator):
    return Population.create(PolicySpec(5, 2, True, (8,)), 3, generator=generator)


def one_group(comparisons, preferences):
    """The comparisons of raters of group 0, who do not contradict each other."""
    strict = preferences["answer"] <= 1
    group = preferences["hidden", "group"][strict]
    return comparisons.rows((group == 0).nonzero().squeeze(-1))


def mean_loss(population, bank, comparisons):
    scores = segment_scores(population, bank, alpha=0.5)
    losses = cpl_loss(
        scores[:, comparisons.preferred], scores[:, comparisons.other], conservatism=0.9
    )
    return losses.mean(1)


def test_descending_lowers_every_members_loss(
    population, bank, comparisons, preferences, generator
):
    comparisons = one_group(comparisons, preferences)
    before = mean_loss(population, bank, comparisons)
    optimizer = torch.optim.Adam(population.members.parameters(), lr=1e-2)
    value = descend(
        CPLLoss(population, bank),
        optimizer,
        comparisons,
        steps=60,
        batch_size=32,
        generator=generator,
    )
    after = mean_loss(population, bank, comparisons)
    assert bool((after < before - 0.1).all())
    assert value == pytest.approx(float(after.mean()), abs=0.15)


def test_each_member_draws_what_its_weights_say(population, bank, comparisons, generator):
    """Member 0 sees comparison 0 alone, member 1 comparison 1, member 2 the last two equally."""
    weight = torch.zeros(3, len(comparisons))
    weight[0, 0] = weight[1, 1] = weight[2, -1] = weight[2, -2] = 1.0
    seen = []
    loss = CPLLoss(population, bank)
    loss.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]["preferred"]))
    descend(
        loss,
        torch.optim.SGD(population.members.parameters(), lr=0.1),
        comparisons,
        steps=2,
        batch_size=200,
        draws=by_comparison(comparisons, weight),
        generator=generator,
    )
    assert len(seen) == 2
    preferred = comparisons.preferred
    for batch in seen:
        assert batch.shape == (3, 200)
        assert bool((batch[0] == preferred[0]).all())
        assert bool((batch[1] == preferred[1]).all())
        share = float((batch[2] == preferred[-1]).float().mean())
        assert preferred[-1] != preferred[-2]
        assert 0.35 < share < 0.65


def test_uniform_draws_differ_between_members_and_cover_everything(
    population, bank, comparisons, generator
):
    seen = []
    loss = CPLLoss(population, bank)
    loss.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    optimizer = torch.optim.SGD(population.members.parameters(), lr=0.1)
    descend(loss, optimizer, comparisons, steps=1, batch_size=2000, generator=generator)
    assert not torch.equal(seen[0]["preferred"][0], seen[0]["preferred"][1])
    drawn = set(
        zip(*(seen[0][key].flatten().tolist() for key in ("preferred", "other")), strict=True)
    )
    pairs = zip(comparisons.preferred.tolist(), comparisons.other.tolist(), strict=True)
    assert drawn == set(pairs)


def test_no_steps_change_nothing(population, bank, comparisons, generator):
    before = population.members.data.clone()
    optimizer = torch.optim.Adam(population.members.parameters())
    loss = CPLLoss(population, bank)
    value = descend(loss, optimizer, comparisons, steps=0, batch_size=4, generator=generator)
    assert math.isnan(value)
    assert bool((population.members.data == before).all())


def test_the_learning_rate_is_held_then_falls_to_zero():
    """Ten steps: 1 for the first half, then 1, 0.8, 0.6, 0.4, 0.2, 0 and 0 for ever."""
    parameter = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    schedule = linear_decay(optimizer, 10)
    rates = []
    for _ in range(13):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    expected = [1.0] * 6 + [0.8, 0.6, 0.4, 0.2, 0.0, 0.0, 0.0]
    assert rates == pytest.approx(expected, abs=1e-9)
