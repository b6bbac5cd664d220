import pytest
import torch
from tensordict import TensorDict
from torch import nn

from popl_rl.data.environments import make_world
from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.acting import Choosing, Optimising, Planning, Rolling, plan
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec, reward_bank
from popl_rl.models.reward_set import RewardSet

HOW = {"episodes": 10, "max_steps": 8, "seed": 0}


def rewards(*rows):
    """Linear rewards over the five cells: one weight ``[2, 5]`` (action, cell) each."""
    networks = []
    for weight in rows:
        network = nn.Sequential(nn.Linear(5, 2, bias=False))
        network[0].weight.data = torch.as_tensor(weight).float()
        networks.append(network)
    return RewardSet(Population(networks, RewardSpec(5, 2, ())), alpha=1.0)


LEFT = [[1, 1, 1, 1, 1], [0, 0, 0, 0, 0]]
RIGHT = [[0, 0, 0, 0, 0], [1, 1, 1, 1, 1]]


@pytest.fixture(scope="module")
def world():
    return make_world("popl_rl.testing:tiny_env", options={"max_steps": 8})


def test_planning_takes_the_best_action_everywhere(world):
    tables = plan(rewards(LEFT, RIGHT), world.table)
    assert tables.shape == (2, 5, 2)
    assert tables[0].argmax(-1).tolist() == [0] * 5
    assert tables[1].argmax(-1).tolist() == [1] * 5


def test_planning_looks_ahead(world):
    # Nothing pays but standing in the last cell: every step leads there.
    last = torch.zeros(2, 5)
    last[:, 4] = 1.0
    assert plan(rewards(last), world.table)[0].argmax(-1)[:4].tolist() == [1] * 4


def test_the_scale_of_a_reward_changes_nothing(world):
    big = 1e6 * torch.tensor(LEFT)
    assert torch.equal(plan(rewards(LEFT), world.table), plan(rewards(big), world.table))


def test_planned_rewards_act(world):
    acting = Planning(world, **HOW)
    episodes = acting(rewards(LEFT, RIGHT))
    assert episodes.shape == (2, 10, 8)
    assert (episodes["action"][0][episodes[MASK][0]] == 0).all()
    assert (episodes["action"][1][episodes[MASK][1]] == 1).all()
    assert acting(None).shape == (1, 10, 8)


def test_planning_needs_a_table(world):
    blind = make_world("gymnasium:make", env_id="CartPole-v1")
    with pytest.raises(ValueError, match="no transition table to plan with; set evaluation"):
        Planning(blind, **HOW)(rewards(LEFT))


def test_reward_functions_do_not_roll_by_themselves(world):
    with pytest.raises(TypeError, match="hypotheses must be a PolicySet, got a RewardSet"):
        Rolling(world, **HOW)(rewards(LEFT))


def test_ppo_finds_what_planning_finds_and_trains_each_reward_once(world):
    trained = []
    cells = TensorDict(
        {"observation": torch.eye(5).unsqueeze(1), "action": torch.zeros(5, 1).long()}, [5, 1]
    )
    bank = reward_bank(cells)
    acting = Optimising(world, **HOW, frames=8192, bank=bank, progress=trained.append)
    episodes = acting(rewards(LEFT, RIGHT, LEFT))
    taken = [float(e["action"][e[MASK]].float().mean()) for e in episodes]
    assert taken[0] < 0.2
    assert taken[1] > 0.8
    acting(rewards(RIGHT))
    assert trained == [1, 2]


@pytest.fixture
def items():
    return TensorDict(
        {
            "observation": torch.arange(20.0).view(20, 1, 1),
            "action": torch.zeros(20, 1, dtype=torch.long),
        },
        [20, 1],
    )


def scalar(weight):
    network = nn.Sequential(nn.Linear(1, 1, bias=False))
    network[0].weight.data.fill_(weight)
    return network


def test_the_best_item_of_each_menu_is_chosen(items):
    choosing = Choosing(items, reward_bank(items), menus=10, items=4, seed=0)
    assert choosing.menus.shape == (10, 4)
    both = RewardSet(Population([scalar(1.0), scalar(-1.0)], RewardSpec(1, 1, ())))
    episodes = choosing(both)
    assert episodes.shape == (2, 10, 1)
    assert episodes[MASK].all()
    menus = choosing.menus.float()
    assert torch.equal(episodes["observation"][0, :, 0, 0], menus.amax(1))
    assert torch.equal(episodes["observation"][1, :, 0, 0], menus.amin(1))
    assert torch.equal(choosing(None)["observation"][0, :, 0, 0], menus[:, 0])
