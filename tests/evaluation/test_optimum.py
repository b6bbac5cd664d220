"""Exact returns on the line of five cells, where walkers start anywhere and never stop."""

import math

import pytest
import torch
from torch import nn

from popl_rl.data.environments import make_world
from popl_rl.evaluation.measures import group_returns, roll_out
from popl_rl.evaluation.optimum import (
    ExactReturns,
    action_probabilities,
    menu_scale,
    optimal_return,
)
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.raters.groups import RaterGroup, make_groups
from popl_rl.raters.response import Response

HORIZON = 3
LEFT = [[1.0, 0.0]] * 5
RIGHT = [[0.0, 1.0]] * 5


def walkers(*pulls):
    """A policy for each pull: log-odds of walking right."""
    networks = []
    for pull in pulls:
        network = nn.Sequential(nn.Linear(5, 2))
        network.load_state_dict(
            {"0.weight": torch.zeros(2, 5), "0.bias": torch.tensor([0.0, pull])}
        )
        networks.append(network)
    return PolicySet(Population(networks, PolicySpec(5, 2, True, ())))


@pytest.fixture
def world():
    return make_world("popl_rl.testing:tiny_env", options={"max_steps": HORIZON})


@pytest.fixture
def groups(world):
    names = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]
    return make_groups(names, label="regret", table=world.table)


@pytest.fixture
def exact(world, groups):
    return ExactReturns(world.table, groups, horizon=HORIZON)


def test_the_optimum_by_hand(exact):
    """Who likes the left walks there. From cell s the next three are max(s - 1, 0) and so on.

    The cells after three steps from 0, 1, 2, 3, 4: 0 0 0, 0 0 0, 1 0 0, 2 1 0, 3 2 1; their sum is
    1 + 3 + 6 = 10. So is the mean return 3 - 10 / 4 / 5 = 2.5, and by symmetry that of the right.
    """
    assert exact.optimum.tolist() == pytest.approx([2.5, 2.5])
    assert exact(torch.tensor([LEFT, RIGHT])).tolist() == [
        pytest.approx([2.5, 0.5]),
        pytest.approx([0.5, 2.5]),
    ]


def test_random_actions_by_hand(exact):
    """The line is symmetric, starts are uniform, and so stay all cells: half of 1 for each step."""
    assert exact.random.tolist() == pytest.approx([1.5, 1.5])


def test_shares_lie_between_random_actions_and_the_optimum(exact):
    assert exact.share_of_optimum(0, 2.5) == pytest.approx(1)
    assert exact.share_of_optimum(1, 1.5) == pytest.approx(0)
    assert exact.share_of_optimum(1, 0.5) == pytest.approx(-1)
    assert exact.share_of_optimum(0, 2.0) == pytest.approx(0.5)


def test_of_who_likes_everything_alike_there_is_no_share(world):
    alike = RaterGroup("alike", lambda steps: torch.full(steps.batch_size, 0.1), Response())
    exact = ExactReturns(world.table, [alike], horizon=HORIZON)
    assert math.isnan(exact.share_of_optimum(0, 0.3))


def test_sampled_and_greedy_policies(world):
    """Log-odds of log(3) for the right are a chance of 3/4; greedily it is always taken."""
    policies = walkers(1.0986123, -2.0)
    sampled = action_probabilities(policies, world.table)
    assert sampled.shape == (2, 5, 2)
    assert sampled[0] == pytest.approx(torch.tensor([[0.25, 0.75]] * 5).numpy(), abs=1e-6)
    greedy = action_probabilities(policies, world.table, greedy=True)
    assert greedy.tolist() == [RIGHT, LEFT]


@pytest.mark.parametrize("greedy", [False, True])
def test_rollouts_agree_within_their_error(world, groups, greedy):
    """Returns have a deviation of about 0.8, so the mean of 1000 one of 0.025."""
    policies = walkers(4.0, 0.5, -0.5)
    exact = ExactReturns(world.table, groups, horizon=HORIZON, greedy=greedy)
    episodes = roll_out(
        world.make, policies, episodes=1000, max_steps=HORIZON, seed=0, greedy=greedy
    )
    rolled = group_returns(episodes, groups)
    assert exact(policies).tolist() == [pytest.approx(row, abs=0.1) for row in rolled.tolist()]


def test_nothing_acts_after_a_terminal_step(world):
    """If the step from cell 1 to cell 0 ends the episode, nothing is earned after it."""
    table = world.table
    terminal = torch.zeros(5, 2, dtype=torch.bool)
    terminal[1, 0] = True
    start = torch.eye(5)[1]
    ends = type(table)(table.steps, table.next_state, terminal, start)
    utility = torch.zeros(5, 2)
    utility[1, 0], utility[:, 1] = 1.0, 0.4
    # Left at once is 1; right, left is 0.4 only; three times right is 1.2; two and left the 0.4s.
    assert optimal_return(ends, utility, horizon=1) == pytest.approx(1.0)
    assert optimal_return(ends, utility, horizon=3) == pytest.approx(1.4)


def test_greedy_returns_are_those_of_the_likeliest_actions(world, groups, exact):
    """However a policy is rated, sampled or not, its greedy returns are the same."""
    policies = walkers(1.0, -0.1)
    rated_greedily = ExactReturns(world.table, groups, horizon=HORIZON, greedy=True)
    for one in (exact, rated_greedily):
        assert one.of_greedy(policies).tolist() == [
            pytest.approx([0.5, 2.5]),
            pytest.approx([2.5, 0.5]),
        ]
    assert exact(policies)[0, 1] < 2.4
    assert exact.of_greedy(None).tolist() == [pytest.approx(exact.random.tolist())]


def test_the_scale_of_menus_by_hand():
    """Two menus of items worth 0, 1 and 2, 4 to one group; the other likes all alike."""
    scale = menu_scale(torch.tensor([[0.0, 1, 2, 4], [1, 1, 1, 1]]), torch.tensor([[0, 1], [2, 3]]))
    assert scale.random.tolist() == [1.75, 1.0]
    assert scale.optimum.tolist() == [2.5, 1.0]
    assert scale.share_of_optimum(0, 2.5) == 1
    assert math.isnan(scale.share_of_optimum(1, 1.0))
