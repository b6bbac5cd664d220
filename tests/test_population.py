import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn

from popl_rl.policies import PolicySpec, build_actor, build_network
from popl_rl.population import Population, segment_scores
from popl_rl.segments import SegmentBank


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


@given(worlds())
@settings(max_examples=15, deadline=None)
def test_chunks_do_not_change_scores(world):
    population, shared, plain = world
    for bank in (shared, plain):
        whole = segment_scores(population, bank)
        pieces = segment_scores(population, bank, memory_mb=0.0)
        torch.testing.assert_close(pieces, whole, atol=1e-5, rtol=1e-5)


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


@pytest.fixture(params=["all", "head"])
def population(request, generator):
    spec = PolicySpec(3, 2, True, (4, 5))
    return Population.create(spec, 4, evolve=request.param, generator=generator)


def parameters_of(population):
    return [value.clone() for value in population.members.data.values(True, True)]


def test_members_are_the_networks_they_were_built_from(generator):
    spec = PolicySpec(3, 2, True, (4,))
    networks = [build_network(spec, generator=generator) for _ in range(3)]
    observation = torch.randn(6, 3, generator=generator)
    with torch.no_grad():
        whole = Population(networks, spec)(observation)
        for network, output in zip(networks, whole, strict=True):
            torch.testing.assert_close(output, network(observation))
        # With heads only, the trunk is that of the first network for everyone.
        heads = Population(networks, spec, evolve="head")(observation)
        features = networks[0][:2](observation)
        for network, output in zip(networks, heads, strict=True):
            torch.testing.assert_close(output, network[2](features))


def test_what_evolves_is_what_has_gradients(population):
    own = sum(value.numel() for value in population.members.parameters())
    head = 4 * (5 * 2 + 2)
    trunk = 3 * 4 + 4 + 4 * 5 + 5
    if population.evolve == "all":
        assert own == head + 4 * trunk
        assert len(population.trunk) == 0
    else:
        assert own == head
        assert sum(value.numel() for value in population.trunk.parameters()) == trunk
    population(torch.zeros(1, 3)).sum().backward()
    assert all(value.grad is not None for value in population.members.parameters())
    assert all(value.grad is None for value in population.trunk.parameters())


def test_replacing_copies_parents_in_place(population):
    before = parameters_of(population)
    held = list(population.members.parameters())
    parents = torch.tensor([2, 2, 0, 1])
    population.replace_(parents)
    for old, new in zip(before, parameters_of(population), strict=True):
        assert torch.equal(new, old[parents])
    assert all(one is two for one, two in zip(held, population.members.parameters(), strict=True))


def test_a_subset_is_a_copy(population):
    before = parameters_of(population)
    some = population.subset([3, 1])
    assert len(some) == 2
    for old, new in zip(before, parameters_of(some), strict=True):
        assert torch.equal(new, old[[3, 1]])
    with torch.no_grad():
        for value in some.members.parameters():
            value.zero_()
    assert all(map(torch.equal, before, parameters_of(population)))
    assert torch.equal(
        population.subset(torch.tensor([3, 1]))(torch.ones(1, 3)),
        population(torch.ones(1, 3))[[3, 1]],
    )


def test_a_network_is_a_copy(population):
    before, trunk = parameters_of(population), population.trunk.state_dict()
    trunk = {name: value.clone() for name, value in trunk.items()}
    network = population.network(1)
    assert all(value.requires_grad for value in network.parameters())
    with torch.no_grad():
        for value in network.parameters():
            value.zero_()
    assert all(map(torch.equal, before, parameters_of(population)))
    assert all(
        torch.equal(value, trunk[name]) for name, value in population.trunk.state_dict().items()
    )


def test_creation_is_reproducible():
    spec = PolicySpec(3, 2, True, (4,))

    def create(seed):
        generator = torch.Generator().manual_seed(seed)
        return parameters_of(Population.create(spec, 3, generator=generator))

    assert all(map(torch.equal, create(1), create(1)))
    assert not any(map(torch.equal, create(1), create(2)))
    # No two members start alike.
    assert not any(torch.equal(value[0], value[1]) for value in create(1))


def test_state_dicts_round_trip(population):
    other = Population.create(
        population.spec, 4, evolve=population.evolve, generator=torch.Generator().manual_seed(9)
    )
    other.load_state_dict(population.state_dict())
    assert torch.equal(other(torch.ones(2, 3)), population(torch.ones(2, 3)))


@pytest.mark.parametrize(
    ("widths", "evolve", "message"),
    [
        ([], "all", "networks must hold at least one network, got none"),
        (
            [3, 4],
            "all",
            r"(?s)networks must share one architecture, got .* and .*; build them all from",
        ),
        ([3], "some", "evolve must be 'all' or 'head', got 'some'"),
    ],
)
def test_a_population_refuses(generator, widths, evolve, message):
    specs = [PolicySpec(2, 2, True, (width,)) for width in widths]
    networks = [build_network(spec, generator=generator) for spec in specs]
    with pytest.raises(ValueError, match=message):
        Population(networks, PolicySpec(2, 2, True, (3,)), evolve=evolve)


def test_no_members_are_refused(generator):
    with pytest.raises(ValueError, match="num_members must be at least 1, got 0"):
        Population.create(PolicySpec(2, 2, True), 0, generator=generator)
