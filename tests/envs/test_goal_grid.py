"""The grid in which every group wants a cell of its own."""

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from popl_rl.data.tables import solve
from popl_rl.envs.goal_grid import GoalGrid, goal_grid, visits
from popl_rl.registry import resolve
from popl_rl.testing import check_env as check_ours


def test_it_is_an_environment_as_gymnasium_wants_it():
    check_env(goal_grid(), skip_render_check=True)
    check_ours("goal_grid")


def test_goals_are_on_the_edge_clockwise():
    """A grid of 3 has 8 outermost cells; four goals are its corners."""
    env = GoalGrid(size=3, goals=4)
    assert env.goal_states == [0, 2, 8, 6]


def test_the_picture_shows_walker_and_goals():
    env = goal_grid(size=3, goals=4, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (72, 72, 3)
    assert (picture == 0).all(-1).sum() == 12 * 12
    assert not (picture[:24, :24] == 255).all(-1).any() or (picture[:24, :24] == 0).any()


def test_the_table_says_what_steps_do():
    env = GoalGrid(size=4, goals=5)
    table = env.transition_table()
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(60):
        action = int(generator.integers(5))
        observation, reward, ended, _, info = env.step(action)
        row = table.steps[int(info["state"]), action]
        assert int(table.next_state[info["state"], action]) == info["next_state"]
        assert int(row["info", "reached"]) == info["reached"]
        assert reward == 0
        assert not ended
        after = table.steps[int(info["next_state"]), 0]["observation"]
        assert torch.equal(after, torch.from_numpy(observation))


def test_a_group_walks_to_its_cell_and_stays():
    env = GoalGrid(size=4, goals=4)
    table = env.transition_table()
    advantages, _ = solve(table, visits(table.steps, 2).double())
    state = 0
    for _ in range(6):
        state = int(table.next_state[state, int(advantages[state].argmax())])
    assert state == env.goal_states[2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 2}, "size must be at least 3"),
        ({"size": 3, "goals": 9}, "goals must be from 1 to 8"),
        ({"goals": 0}, "goals must be from 1 to 16"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
        ({"render_mode": "human"}, "render_mode"),
    ],
)
def test_what_it_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        GoalGrid(**options)


def test_an_action_that_does_not_exist():
    env = GoalGrid()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="from 0 to 4, got 5"):
        env.step(5)


def test_a_rater_with_arguments():
    table = GoalGrid(goals=3).transition_table()
    assert torch.equal(resolve("rater", "visits(1)")(table.steps), visits(table.steps, 1))


@pytest.mark.parametrize("reference", ["visits(x)", "visits(1", "visits(,)"])
def test_arguments_that_cannot_be_read(reference):
    with pytest.raises(ValueError, match="rater"):
        resolve("rater", reference)
