"""Populations as stacks of networks: what is shared, copied, replaced and refused."""

import pytest
import torch

from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.population import Population


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
