"""Scores of segments: by hand, by the simple way, and within bounds of memory."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec, build_actor
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import segment_scores
from popl_rl.selection.lexicase import lexicase_selection


@st.composite
def worlds(draw):
    """A population and one set of segments, indexed with and without shared observations."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    discrete = draw(st.booleans())
    spec = PolicySpec(
        observation_dim=draw(st.integers(1, 3)),
        action_dim=draw(st.integers(1, 3)),
        discrete=discrete,
        hidden=draw(st.sampled_from([(), (5,), (4, 3)])),
        action_std=draw(st.sampled_from([0.5**0.5, 0.2])),
    )
    population = Population.create(
        spec,
        draw(st.integers(1, 4)),
        evolve=draw(st.sampled_from(["all", "head"])),
        generator=generator,
    )
    shape = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    distinct = draw(st.integers(1, 5))
    observation = torch.randn(distinct, spec.observation_dim, generator=generator)
    row = torch.randint(distinct, shape, generator=generator)
    if discrete:
        action = torch.randint(spec.action_dim, shape, generator=generator)
    else:
        action = torch.randn(*shape, spec.action_dim, generator=generator)
    shared = SegmentBank(observation, row, action, True)
    steps = torch.arange(row.numel()).view(shape)
    plain = SegmentBank(observation[row].flatten(0, 1), steps, action, False)
    return population, shared, plain


def linear(weights, biases):
    """A linear policy with the given parameters."""
    network = nn.Sequential(nn.Linear(len(weights[0]), len(weights)))
    network.load_state_dict({"0.weight": torch.tensor(weights), "0.bias": torch.tensor(biases)})
    return network


def test_scores_by_hand():
    """Two members, two segments of two steps, two observations A = (1, 0) and B = (0, 1).

    Member 0 takes action 0 with probability 1/2 in A (logits 0, 0) and 3/4 in B (logits ln 3, 0);
    member 1 with 1/5 and 1/2 (logits 0, ln 4 and 0, 0).
    Segment 0 is (A, action 0), (B, action 0): probabilities 1/2, 3/4 and 1/5, 1/2.
    Segment 1 is (A, action 1), (A, action 0): probabilities 1/2, 1/2 and 4/5, 1/5.
    The score is alpha (ln p_0 + gamma ln p_1), here with alpha = 2 and gamma = 1/2.
    """
    population = Population(
        [
            linear([[0.0, math.log(3)], [0.0, 0.0]], [0.0, 0.0]),
            linear([[-math.log(4), 0.0], [0.0, 0.0]], [0.0, 0.0]),
        ],
        PolicySpec(2, 2, True, ()),
    )
    row, action = torch.tensor([[0, 1], [0, 0]]), torch.tensor([[0, 0], [1, 0]])
    bank = SegmentBank(torch.eye(2), row, action, True)
    scores = segment_scores(population, bank, alpha=2.0, discount=0.5)
    expected = [
        [2 * math.log(1 / 2) + math.log(3 / 4), 2 * math.log(1 / 2) + math.log(1 / 2)],
        [2 * math.log(1 / 5) + math.log(1 / 2), 2 * math.log(4 / 5) + math.log(1 / 5)],
    ]
    torch.testing.assert_close(scores, torch.tensor(expected))
    assert scores.dtype == torch.float32


def test_continuous_scores_by_hand():
    """The policy does nothing: mu = 0. Actions 1, 2 then 0, 3: -(1 + 4) and -(0 + 9)."""
    population = Population([linear([[0.0]], [0.0])], PolicySpec(1, 1, False, ()))
    action = torch.tensor([[[1.0], [2.0]], [[0.0], [3.0]]])
    bank = SegmentBank(torch.ones(4, 1), torch.arange(4).view(2, 2), action, False)
    torch.testing.assert_close(segment_scores(population, bank), torch.tensor([[-5.0, -9.0]]))


@given(worlds(), st.sampled_from([1.0, 0.3]), st.sampled_from([1.0, 0.9]))
@settings(max_examples=40, deadline=None)
def test_scores_are_what_each_members_actor_says(world, alpha, discount):
    """Shared and plain segments score alike, and as TorchRL's actors of the single members do.

    TorchRL's Gaussian has a constant more for each step, ln(std sqrt(2 pi)) for each dimension.
    """
    population, shared, plain = world
    spec = population.spec
    arguments = {"alpha": alpha, "discount": discount}
    scores = segment_scores(population, shared, **arguments)
    assert scores.shape == (len(population), len(shared))
    torch.testing.assert_close(
        scores, segment_scores(population, plain, **arguments), atol=1e-5, rtol=1e-5
    )
    steps = TensorDict(
        {"observation": plain.observation[plain.row], "action": plain.action}, plain.row.shape
    )
    constant = 0.0 if spec.discrete else math.log(spec.action_std * math.sqrt(2 * math.pi))
    weight = alpha * discount ** torch.arange(plain.row.shape[1])
    for member in range(len(population)):
        actor = build_actor(spec, population.network(member))
        with torch.no_grad():
            log_prob = actor.get_dist(steps).log_prob(steps["action"])
        expected = (log_prob + spec.action_dim * constant) @ weight
        torch.testing.assert_close(scores[member], expected, atol=1e-5, rtol=1e-5)


@given(worlds(), st.sampled_from([0.0, 1e-4, 3e-4, 1e-3]))
@settings(max_examples=30, deadline=None)
def test_chunks_do_not_change_scores(world, memory_mb):
    population, shared, plain = world
    for bank in (shared, plain):
        whole = segment_scores(population, bank)
        pieces = segment_scores(population, bank, memory_mb=memory_mb)
        torch.testing.assert_close(pieces, whole, atol=1e-5, rtol=1e-5)


def simply(population, bank, *, alpha=1.0, discount=1.0):
    """Scores as they are defined, one network after the other."""
    weight = alpha * discount ** torch.arange(bank.row.shape[1]).float()
    observation, spec = bank.observation[bank.row], population.spec
    with torch.no_grad():
        rows = [
            spec.step_scores(population.network(member)(observation), bank.action) @ weight
            for member in range(len(population))
        ]
    return torch.stack(rows)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize("memory_mb", [256.0, 0.01, 0.0])
@pytest.mark.parametrize(
    "spec",
    [
        RewardSpec(3, 4, (6, 5)),
        RewardSpec(3, 1, (6,)),
        RewardSpec(3, 2, ()),
        PolicySpec(3, 4, True, (6, 5)),
        PolicySpec(3, 2, False, (6, 5)),
    ],
)
def test_every_way_to_score_is_the_simple_one(generator, spec, evolve, shared, memory_mb):
    population = Population.create(spec, 7, evolve=evolve, generator=generator)
    bank = random_bank(spec, generator, segments=40, steps=5, distinct=9 if shared else None)
    arguments = {"alpha": 0.7, "discount": 0.9}
    for _ in range(2):  # with and without the features of the last time
        torch.testing.assert_close(
            segment_scores(population, bank, memory_mb=memory_mb, **arguments),
            simply(population, bank, **arguments),
            atol=1e-5,
            rtol=1e-4,
        )


def random_bank(spec, generator, *, segments, steps, distinct=None):
    rows = distinct or segments * steps
    observation = torch.randn(rows, spec.observation_dim, generator=generator)
    row = torch.arange(segments * steps).view(segments, steps) % rows
    if spec.discrete:
        action = torch.randint(spec.action_dim, row.shape, generator=generator)
    else:
        action = torch.randn(*row.shape, spec.action_dim, generator=generator)
    return SegmentBank(observation, row, action, distinct is not None)


HEADS = [PolicySpec(3, 2, False, (6,)), PolicySpec(3, 2, True, (6,)), RewardSpec(3, 2, (6,))]


@pytest.mark.parametrize("spec", HEADS)
def test_the_frozen_trunk_looks_at_a_bank_once(generator, spec):
    population = Population.create(spec, 4, evolve="head", generator=generator)
    bank = random_bank(spec, generator, segments=20, steps=5)
    looked = []
    population.trunk.register_forward_hook(lambda *_: looked.append(1))
    first = segment_scores(population, bank)
    assert looked
    looked.clear()
    assert torch.equal(segment_scores(population, bank), first)
    # Copies share the trunk, and so what it has seen; children differ in their heads only.
    torch.testing.assert_close(segment_scores(population.subset([2, 0]), bank), first[[2, 0]])
    population.replace_(torch.tensor([1, 1, 1, 1]))
    torch.testing.assert_close(segment_scores(population, bank), first[[1, 1, 1, 1]])
    same = SegmentBank(bank.observation, bank.row, bank.action, False)
    segment_scores(population, same)
    assert not looked
    segment_scores(population, bank, memory_mb=0.0)  # too little to keep anything
    assert looked


@pytest.mark.parametrize("spec", HEADS)
@pytest.mark.parametrize("change", ["load", "step", "data", "bank", "observation", "discount"])
def test_what_the_trunk_has_seen_is_forgotten_when_it_no_longer_holds(generator, spec, change):
    population = Population.create(spec, 4, evolve="head", generator=generator)
    bank = random_bank(spec, generator, segments=20, steps=5)
    segment_scores(population, bank)
    weight, discount = population.trunk[0].weight, 1.0
    if change == "load":
        state = population.trunk.state_dict()
        population.trunk.load_state_dict({name: 2 * value for name, value in state.items()})
    elif change == "step":
        with torch.no_grad():
            weight.add_(0.1)
    elif change == "data":
        weight.data = weight.data + 0.1
    elif change == "bank":
        bank = random_bank(spec, generator, segments=20, steps=5)
    elif change == "observation":
        bank.observation.mul_(2)
    else:
        discount = 0.5
    torch.testing.assert_close(
        segment_scores(population, bank, discount=discount),
        simply(population, bank, discount=discount),
        atol=1e-5,
        rtol=1e-4,
    )


@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize("spec", [*HEADS, RewardSpec(3, 1, (6,))])
@pytest.mark.parametrize("distinct", [None, 400])
def test_temporaries_stay_within_their_bound(generator, spec, evolve, distinct):
    """No tensor made on the way, but for the result, is larger than the memory granted."""
    population = Population.create(spec, 50, evolve=evolve, generator=generator)
    bank = random_bank(spec, generator, segments=400, steps=8, distinct=distinct)
    whole = segment_scores(population, bank)
    memory_mb = 0.2
    with Largest() as largest:
        pieces = segment_scores(population, bank, memory_mb=memory_mb)
    torch.testing.assert_close(pieces, whole, atol=1e-5, rtol=1e-4)
    assert 0 < largest.bytes <= memory_mb * 2**20 / 2


class Largest(TorchDispatchMode):
    """Watches for the largest memory behind a tensor, but for that of the scores ``[50, 400]``."""

    bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor):
            size = result.untyped_storage().nbytes()
            self.bytes = max(self.bytes, size if size != 50 * 400 * 4 else 0)
        return result


TRAINED = [
    (PolicySpec(6, 4, True, (32, 32)), 20),
    (PolicySpec(6, 2, False, (32, 32)), None),
    (RewardSpec(6, 1, (32, 32)), None),
]


@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize(("spec", "distinct"), TRAINED)
def test_half_precision_agrees_but_for_near_ties(generator, spec, distinct, evolve):
    """Passes and, where they agree, parents; on members made different by training."""
    population = Population.create(spec, 12, evolve=evolve, generator=generator)
    bank = random_bank(spec, generator, segments=100, steps=6, distinct=distinct)
    pairs = torch.randint(100, (2, 300), generator=generator)
    train_apart(population, bank, pairs, generator)
    margin, half = (
        scores[:, pairs[0]] - scores[:, pairs[1]]
        for scores in (
            segment_scores(population, bank),
            segment_scores(population, bank, dtype=torch.bfloat16),
        )
    )
    assert half.dtype == torch.float32
    clear = margin.abs() > 0.1 * margin.std(1, keepdim=True)
    differ = (margin > 0) != (half > 0)
    assert not differ[clear].any()
    assert differ.float().mean() < 0.02
    agreed = ~differ.any(0)  # cases on which nobody is nearly tied
    assert agreed.float().mean() > 0.5
    parents = [
        lexicase_selection(value[:, agreed] > 0, 100, generator=torch.Generator().manual_seed(1))
        for value in (margin, half)
    ]
    assert torch.equal(*parents)


def train_apart(population, bank, pairs, generator):
    """A few steps of each member towards raters of its own, half of whose answers are random."""
    flip = torch.rand(len(population), pairs.shape[1], generator=generator) < 0.5
    target = torch.where(flip, -1.0, 1.0)
    optimizer = torch.optim.Adam(population.members.parameters(), lr=1e-2)
    action = bank.action.flatten(0, 1)
    for _ in range(30):
        output = population(bank.observation)[:, bank.row.flatten()]
        value = population.spec.step_scores(output, action)
        scores = value.unflatten(1, bank.row.shape).sum(2)
        margin = scores[:, pairs[0]] - scores[:, pairs[1]]
        loss = nn.functional.softplus(-margin * target).mean(1).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize(("spec", "distinct"), TRAINED)
@pytest.mark.parametrize("memory_mb", [256.0, 1.0])
def test_scores_on_cuda_are_those_on_the_cpu(generator, spec, distinct, evolve, memory_mb):
    population = Population.create(spec, 24, evolve=evolve, generator=generator)
    bank = random_bank(spec, generator, segments=300, steps=10, distinct=distinct)
    expected = segment_scores(population, bank, discount=0.9)
    assert population.to("cuda").device.type == "cuda"
    for _ in range(2):
        scores = segment_scores(population, bank.to("cuda"), discount=0.9, memory_mb=memory_mb)
        assert scores.is_cuda
        torch.testing.assert_close(scores.cpu(), expected, atol=1e-4, rtol=1e-4)
    parents = lexicase_selection(scores > 0, 100, generator=torch.Generator("cuda").manual_seed(0))
    assert parents.is_cuda


@given(worlds(), st.randoms(use_true_random=False))
@settings(max_examples=15, deadline=None)
def test_permuting_members_permutes_scores(world, random):
    population, shared, plain = world
    order = list(range(len(population)))
    random.shuffle(order)
    for bank in (shared, plain):
        permuted = segment_scores(population.subset(order), bank)
        torch.testing.assert_close(
            permuted, segment_scores(population, bank)[order], atol=1e-5, rtol=1e-5
        )


@given(worlds())
@settings(max_examples=15, deadline=None)
def test_a_row_computes_what_its_network_computes(world):
    population, shared, _ = world
    observation = shared.observation
    with torch.no_grad():
        together = population(observation)
        each = torch.stack([population.network(n)(observation) for n in range(len(population))])
        own = population(observation.expand(len(population), *observation.shape))
    torch.testing.assert_close(together, each, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(own, together, atol=1e-5, rtol=1e-5)


def test_integer_scales_are_as_good_as_real_ones(bank, generator):
    population = Population.create(PolicySpec(5, 2, True, (3,)), 2, generator=generator)
    whole = segment_scores(population, bank, alpha=1, discount=1)
    assert torch.equal(whole, segment_scores(population, bank))


@pytest.mark.parametrize("count", [0, 3, 8])
def test_only_wanted_segments_need_be_scored(generator, count):
    """Each has the score that it has among all."""
    spec = PolicySpec(3, 2, False, (8, 4))
    population = Population.create(spec, 5, generator=generator)
    observation = torch.randn(8 * 6, 3, generator=generator)
    row = torch.arange(48).view(8, 6)
    bank = SegmentBank(observation, row, torch.randn(8, 6, 2, generator=generator), False)
    wanted = torch.randperm(8, generator=generator)[:count]
    found = segment_scores(population, bank, wanted=wanted)
    assert torch.allclose(found[:, wanted], segment_scores(population, bank)[:, wanted], atol=1e-5)
    left = torch.ones(8, dtype=torch.bool).index_fill(0, wanted, False)
    assert bool(found[:, left].isnan().all())
