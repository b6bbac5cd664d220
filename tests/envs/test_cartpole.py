"""CartPole: who wants what, and whether the scripts of the data do it."""

import torch
from tensordict import TensorDict

from popl_rl.config import plain
from popl_rl.envs.cartpole import left, right
from popl_rl.evaluation.acting import Rolling
from popl_rl.evaluation.measures import group_returns
from popl_rl.experiments.data import build_groups, build_world
from popl_rl.testing import tiny_env


def test_utilities_by_place():
    place = torch.tensor([-2.5, -2.0, -1.0, -0.25, 0.0, 0.5, 1.0])
    observation = torch.stack([place, *torch.rand(3, 7)], -1).unsqueeze(0)
    steps = TensorDict({"observation": observation}, [1, 7])
    assert left(steps).tolist() == [[0, 0, 1, 0.25, 0, 0, 0]]
    assert right(steps).tolist() == [[0, 0, 0, 0, 0, 0.5, 1]]


def test_raters_of_the_same_name_elsewhere_are_not_meant(config_of):
    for rater in (left, right):
        assert rater.fits(build_world(plain(config_of("env=cartpole")).env).env.unwrapped) is None
        assert "as in my_raters.py:left" in rater.fits(tiny_env())


def test_each_group_finds_its_script_in_the_data(config_of):
    config = plain(config_of("env=cartpole", "env.noise=[0,0.3]"))
    world = build_world(config.env)
    groups = build_groups(config.raters, world)
    acting = Rolling(world, episodes=5, max_steps=200, seed=0)
    returns = {
        name: group_returns(acting.behaviours([name]), groups)[0].tolist()
        for name in ("to_the_left", "to_the_right", "balance")
    }
    assert returns["to_the_left"][0] > 100 > 5 > returns["to_the_left"][1]
    assert returns["to_the_right"][1] > 100 > 5 > returns["to_the_right"][0]
    assert max(returns["balance"]) < 30
    assert set(world.shares) >= {"to_the_left~0.3", "balance"}
