"""Rows of what the data's behaviours are worth to each group."""

import gymnasium
import pytest
import torch

from popl_rl import registry
from popl_rl.data.environments import make_world
from popl_rl.evaluation.acting import Rolling
from popl_rl.evaluation.protocol import MeasuredInfos
from popl_rl.evaluation.references import score_behaviours
from popl_rl.evaluation.results import Rows
from popl_rl.raters.groups import make_groups
from popl_rl.testing import likes_left, likes_right, tiny_env


class Walkers(gymnasium.Wrapper):
    """The line of five cells, in which the data show three ways to walk."""

    def behaviours(self):
        def walk(action):
            return lambda step, generator: torch.full(step.batch_size, action)  # noqa: ARG005

        return {"left": walk(0), "right": walk(1), "unused": walk(0)}


def walkers():
    return Walkers(tiny_env(max_steps=8))


def rows_of_behaviours(mixture=None, factory=walkers):
    with registry.isolated():
        registry.env("walkers")(factory)
        world = make_world("walkers", mixture=mixture)
        acting = Rolling(world, episodes=20, max_steps=8, seed=0)
        groups = make_groups([likes_left, likes_right], label="return")
        nothing = torch.full((2,), float("nan"))
        rows = Rows(groups, MeasuredInfos(""), floor=nothing, oracle=nothing)
        score_behaviours(rows, acting)
    return rows.table().set_index(["method", "choice", "group", "measure"])["value"]


def test_behaviours_the_best_for_each_group_and_all_in_their_shares():
    found = rows_of_behaviours({"left": 0.25, "right": 0.75})
    assert set(found.index.get_level_values("choice")) == {"", "left", "right"}
    for group, best in (("likes_left", "left"), ("likes_right", "right")):
        left, right = (found["behaviour", name, group, "return"] for name in ("left", "right"))
        assert found["best_behaviour", "", group, "return"] == max(left, right)
        assert found["behaviour", best, group, "return"] == max(left, right)
        assert found["data", "", group, "return"] == pytest.approx(0.25 * left + 0.75 * right)
        assert found["data", "", group, "length"] == 8
        assert found["data", "", group, "return_error"] > 0


def test_random_actions_alone_have_no_rows_of_their_own():
    assert rows_of_behaviours(factory=lambda: tiny_env(max_steps=8)).empty
