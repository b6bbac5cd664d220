"""The delivery grid: what moving is worth, what the table says, and boards from files."""

import gymnasium
import numpy as np
import pytest
import torch

from popl_rl.data.tables import solve
from popl_rl.envs.delivery import DeliveryGrid
from popl_rl.testing import check_env


def test_it_is_an_environment_that_runs_can_use():
    check_env("delivery", num_steps=60)


def test_rewards_by_hand():
    grid = DeliveryGrid()
    reward = grid.step_reward
    assert reward[0, 0].tolist() == [-1, -1, -1, -1]  # off the board: stays, and pays for the step
    assert reward[0, 1, 3] == -2  # into a roadblock
    assert reward[0, 2].tolist() == [-1, -50, -1, 50]  # a sheep below, the goal to the right
    assert reward[1, 0, 1] == 0  # a coin
    assert reward[2, 2, 3] == -2  # out of mud
    assert reward[0, 1, 1] == -1  # a house blocks the way


def test_the_table_is_what_steps_do():
    grid = DeliveryGrid()
    table = grid.transition_table()
    for cell in np.flatnonzero(grid.open):
        for action in range(4):
            grid.reset(seed=0)
            grid.cell = int(cell)
            observation, reward, ended, _, info = grid.step(action)
            assert table.next_state[cell, action] == info["next_state"]
            assert table.terminal[cell, action] == ended
            assert table.steps["reward"][cell, action] == reward
            assert (
                table.steps["observation"][info["next_state"], 0].tolist() == observation.tolist()
            )
    assert table.start.sum() == pytest.approx(1)
    advantage, value = solve(table, table.steps["reward"], discount=0.99)
    assert value[2] == 50
    assert advantage[2, 3] == 0


def test_segments_are_walked():
    grid = DeliveryGrid()
    cell, there = grid.walk(np.array([[0, 1], [0, 2]]), np.array([[3, 2, 0], [3, -1, -1]]))
    assert cell.tolist() == [[1, 2, 1], [2, 3, 3]]
    assert there.tolist() == [[True, True, True], [True, False, False]]
    assert grid.observe(cell).shape == (2, 3, 16)


def test_boards_are_read_from_files(tmp_path):
    np.savez(tmp_path / "board.npz", board=np.array([[0, 0, 1]]))
    grid = DeliveryGrid(board=str(tmp_path / "board.npz"), start=(0, 0), max_steps=5)
    assert isinstance(grid.observation_space, gymnasium.spaces.Box)
    assert grid.reset(seed=0)[1]["state"] == 0
    assert [grid.step(3)[1:3] for _ in range(2)] == [(-1, False), (50, True)]
    assert torch.equal(grid.transition_table().start, torch.tensor([1.0, 0, 0]))


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ({"other": np.zeros(3)}, "must hold 'board' of shape"),
        (
            {"board": np.zeros((2, 2)), "step_reward": np.zeros((2, 2, 3))},
            r"step_reward must have shape \[2, 2, 4\], got \[2, 2, 3\]",
        ),
    ],
)
def test_files_that_are_no_boards_are_refused(tmp_path, held, message):
    np.savez(tmp_path / "board.npz", **held)
    with pytest.raises(ValueError, match=message):
        DeliveryGrid(board=str(tmp_path / "board.npz"))


def test_wrong_arguments_are_refused(tmp_path):
    with pytest.raises(ValueError, match="there is no"):
        DeliveryGrid(board=str(tmp_path / "nothing.npz"))
    with pytest.raises(ValueError, match="start must be a cell that one can drive from"):
        DeliveryGrid(start=(0, 3))
    with pytest.raises(ValueError, match="render_mode must be None"):
        DeliveryGrid(render_mode="human")
