import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl.models.policies import build_network
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec, reward_bank
from popl_rl.models.scoring import segment_scores


class Spaces(gymnasium.Env):
    def __init__(self, observation_space, action_space):
        self.observation_space = observation_space
        self.action_space = action_space


BOX = gymnasium.spaces.Box(-1, 1, (3,), np.float32)


@pytest.fixture
def continuous(generator):
    """Five segments of two steps with actions of two numbers."""
    return TensorDict(
        {
            "observation": torch.rand(5, 2, 3, generator=generator),
            "action": torch.rand(5, 2, 2, generator=generator),
        },
        [5, 2],
    )


def test_a_reward_for_each_discrete_action():
    assert RewardSpec.from_env(Spaces(BOX, gymnasium.spaces.Discrete(4))) == RewardSpec(3, 4)


def test_continuous_actions_are_read_beside_the_observation():
    spec = RewardSpec.from_env(Spaces(BOX, gymnasium.spaces.Box(-1, 1, (2,))), hidden=[7])
    assert spec == RewardSpec(5, 1, (7,))


@pytest.mark.parametrize(
    ("observation", "action", "what"),
    [
        (gymnasium.spaces.Discrete(3), gymnasium.spaces.Discrete(2), "observation_space"),
        (BOX, gymnasium.spaces.MultiBinary(2), "action_space"),
    ],
)
def test_other_spaces_are_refused(observation, action, what):
    with pytest.raises(TypeError, match=f"{what} must be"):
        RewardSpec.from_env(Spaces(observation, action))


@pytest.mark.parametrize(
    "arguments", [{"observation_dim": 0}, {"observation_dim": 1, "hidden": (0,)}]
)
def test_sizes_must_be_positive(arguments):
    with pytest.raises(ValueError, match="at least 1"):
        RewardSpec(**arguments)


def test_the_last_layer_has_no_bias(generator):
    names = dict(build_network(RewardSpec(3, 2, (4,)), generator=generator).named_parameters())
    assert sorted(names) == ["0.bias", "0.weight", "2.weight"]


def test_a_segment_is_worth_the_sum_of_its_rewards():
    # One linear reward: r(s, a) = w_a . s.
    network = torch.nn.Sequential(torch.nn.Linear(2, 2, bias=False))
    network[0].weight.data = torch.tensor([[1.0, 0.0], [0.0, 10.0]])
    population = Population([network], RewardSpec(2, 2, ()))
    segments = TensorDict(
        {
            "observation": torch.tensor([[[1.0, 2.0], [3.0, 4.0]]]),
            "action": torch.tensor([[0, 1]]),
        },
        [1, 2],
    )
    scores = segment_scores(population, reward_bank(segments), alpha=0.5, discount=0.1)
    assert scores.tolist() == [[pytest.approx(0.5 * (1.0 + 0.1 * 40.0))]]


def test_joined_actions_are_scored_like_a_loop(continuous, generator):
    population = Population.create(RewardSpec(5, 1, (6,)), 3, generator=generator)
    scores = segment_scores(population, reward_bank(continuous))
    joined = torch.cat([continuous["observation"], continuous["action"]], -1)
    for member in range(3):
        with torch.no_grad():
            expected = population.network(member)(joined).squeeze(-1).sum(1)
        torch.testing.assert_close(scores[member], expected)


def test_the_segments_themselves_stay_as_they_are(continuous):
    before = continuous.clone()
    reward_bank(continuous)
    assert (continuous == before).all()
