import math

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type

from popl_rl.models.policies import PolicySpec, build_actor, build_network, log_prob
from popl_rl.testing import tiny_env


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation_dim": 0}, "observation_dim must be at least 1, got 0"),
        ({"action_dim": 0}, "action_dim must be at least 1, got 0"),
        ({"hidden": (4, 0)}, r"hidden must hold layer widths of at least 1, got \(4, 0\)"),
        ({"action_std": 0.0}, "action_std must be positive, got 0.0"),
        ({"action_std": math.nan}, "action_std must be positive, got nan"),
    ],
)
def test_a_spec_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        PolicySpec(**{"observation_dim": 2, "action_dim": 2, "discrete": True, **change})


def test_a_spec_is_read_off_an_environment():
    assert PolicySpec.from_env(tiny_env(), hidden=[3]) == PolicySpec(5, 2, True, (3,))
    pendulum = PolicySpec.from_env(gymnasium.make("Pendulum-v1"), hidden=(), action_std=0.1)
    assert pendulum == PolicySpec(3, 1, False, (), 0.1)


class Spaces(gymnasium.Env):
    def __init__(self, observation_space=None, action_space=None):
        self.observation_space = observation_space or gymnasium.spaces.Box(0, 1, (2,))
        self.action_space = action_space or gymnasium.spaces.Discrete(2)


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        (
            {"observation_space": gymnasium.spaces.Box(0, 1, (2, 2))},
            "observation_space must be a Box of one dimension, got .*FlattenObservation",
        ),
        (
            {"observation_space": gymnasium.spaces.Discrete(4)},
            r"observation_space must be a Box of one dimension, got Discrete\(4\)",
        ),
        (
            {"action_space": gymnasium.spaces.MultiDiscrete([2, 2])},
            "action_space must be Discrete or a Box of one dimension, got MultiDiscrete",
        ),
        (
            {"action_space": gymnasium.spaces.Box(0, 1, (2, 2))},
            "action_space must be Discrete or a Box of one dimension, got Box",
        ),
    ],
)
def test_other_spaces_are_refused(spaces, message):
    with pytest.raises(TypeError, match=message):
        PolicySpec.from_env(Spaces(**spaces))


@pytest.mark.parametrize(("hidden", "sizes"), [((), [(3, 2)]), ((5, 4), [(3, 5), (5, 4), (4, 2)])])
def test_a_network_has_the_layers_of_its_spec(generator, hidden, sizes):
    network = build_network(PolicySpec(3, 2, True, hidden), generator=generator)
    linear = [(layer.in_features, layer.out_features) for layer in network[::2]]
    assert linear == sizes
    assert all(isinstance(layer, nn.ReLU) for layer in network[1::2])
    assert network(torch.zeros(7, 6, 3)).shape == (7, 6, 2)


def test_initial_weights_come_from_the_generator_alone():
    spec = PolicySpec(3, 2, True, (4,))

    def weights(seed):
        return build_network(spec, generator=torch.Generator().manual_seed(seed))[0].weight

    before = torch.random.get_rng_state()
    one = weights(5)
    assert torch.equal(before, torch.random.get_rng_state())
    torch.rand(3)
    assert torch.equal(one, weights(5))
    assert not torch.equal(one, weights(6))


def test_log_probabilities_by_hand():
    """Logits (ln 3, 0) give probabilities 3/4 and 1/4.

    A Gaussian policy with variance 1/2 gives -|mu - a|^2: with mu = (1, 2) and a = (0, 4) that is
    -(1 + 4) = -5; with standard deviation 2 it is -5 / (2 * 4).
    """
    discrete = PolicySpec(1, 2, True)
    output, action = torch.tensor([[math.log(3), 0.0]] * 2), torch.tensor([0, 1])
    expected = torch.tensor([0.75, 0.25]).log()
    torch.testing.assert_close(log_prob(discrete, output, action), expected)
    mean, action = torch.tensor([1.0, 2.0]), torch.tensor([0.0, 4.0])
    assert float(log_prob(PolicySpec(1, 2, False), mean, action)) == pytest.approx(-5)
    wide = PolicySpec(1, 2, False, action_std=2.0)
    assert float(log_prob(wide, mean, action)) == pytest.approx(-5 / 8)


@given(
    st.booleans(), st.integers(1, 3), st.sampled_from([(), (4,)]), st.floats(0.1, 3), st.integers(0)
)
@settings(max_examples=25, deadline=None)
def test_actors_agree_with_log_prob(discrete, action_dim, hidden, action_std, seed):
    """TorchRL's Gaussian has a constant more: ln(std sqrt(2 pi)) for each dimension."""
    generator = torch.Generator().manual_seed(seed % 2**31)
    spec = PolicySpec(3, action_dim, discrete, hidden, action_std)
    network = build_network(spec, generator=generator)
    actor = build_actor(spec, network)
    observation = torch.randn(6, 3, generator=generator)
    if discrete:
        action, constant = torch.randint(action_dim, (6,), generator=generator), 0.0
    else:
        action = torch.randn(6, action_dim, generator=generator)
        constant = action_dim * math.log(action_std * math.sqrt(2 * math.pi))
    data = TensorDict({"observation": observation, "action": action}, [6])
    with torch.no_grad():
        ours = log_prob(spec, network(observation), action)
        theirs = actor.get_dist(data).log_prob(action)
    torch.testing.assert_close(theirs + constant, ours, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("discrete", [True, False])
def test_actions_are_shared_by_members(generator, discrete):
    spec = PolicySpec(1, 2, discrete)
    output = torch.randn(3, 4, 2, generator=generator)
    if discrete:
        action = torch.randint(2, (4,), generator=generator)
    else:
        action = torch.randn(4, 2, generator=generator)
    together = log_prob(spec, output, action)
    assert together.shape == (3, 4)
    for member in range(3):
        assert torch.equal(together[member], log_prob(spec, output[member], action))


def test_actors_act(generator):
    observation = TensorDict({"observation": torch.zeros(5, 3)}, [5])
    for spec, dtype, shape in (
        (PolicySpec(3, 2, True), torch.int64, (5,)),
        (PolicySpec(3, 2, False), torch.float32, (5, 2)),
    ):
        actor = build_actor(spec, build_network(spec, generator=generator))
        action = actor(observation.clone())["action"]
        assert action.dtype == dtype
        assert action.shape == shape


def test_actions_that_begin_elsewhere_by_hand():
    """Logits (ln 3, 0) over the actions 5 and 6: chances 3/4 and 1/4."""
    spec = PolicySpec(1, 2, True, (), first_action=5)
    network = nn.Sequential(nn.Linear(1, 2))
    torch.nn.init.zeros_(network[0].weight)
    network[0].bias.data = torch.tensor([math.log(3), 0.0])
    actor = build_actor(spec, network)
    step = TensorDict({"observation": torch.zeros(400, 1)}, [400])
    assert actor(step.clone())["action"].unique().tolist() == [5], "the most likely"
    with torch.random.fork_rng(), set_exploration_type(ExplorationType.RANDOM):
        drawn = actor(step.clone())["action"]
    assert drawn.unique().tolist() == [5, 6]
    assert 0.65 < float((drawn == 5).float().mean()) < 0.85
    distribution = actor.get_dist(step)
    log_prob = distribution.log_prob(torch.tensor([5, 6]).repeat(200)).exp()
    torch.testing.assert_close(log_prob, torch.tensor([0.75, 0.25]).repeat(200))
    wide = distribution.expand([2, 400])
    assert wide.mode.shape == (2, 400)
    torch.testing.assert_close(wide.entropy(), distribution.entropy().expand(2, -1))


def test_a_gaussian_actor_has_the_spread_of_its_spec():
    spec = PolicySpec(1, 1, False, (), 0.25)
    network = nn.Sequential(nn.Linear(1, 1))
    torch.nn.init.constant_(network[0].weight, 0.0)
    torch.nn.init.constant_(network[0].bias, 3.0)
    distribution = build_actor(spec, network).get_dist(
        TensorDict({"observation": torch.zeros(2, 1)}, [2])
    )
    np.testing.assert_allclose(distribution.mean.detach().numpy(), 3.0)
    np.testing.assert_allclose(distribution.base_dist.scale.detach().numpy(), 0.25)
