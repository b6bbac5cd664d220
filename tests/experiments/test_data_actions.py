"""Environments whose actions do not begin with 0, and raters of float64, from data to results."""

from dataclasses import replace

import gymnasium
import pandas as pd
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, GymWrapper, set_exploration_type

from popl_rl.data.behaviours import random_behaviour, table_behaviour
from popl_rl.data.environments import counting_from_zero, indexed, make_world
from popl_rl.evaluation.measures import roll_out
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.storage import load_tensordict
from popl_rl.testing import check_env, tiny_env
from popl_rl.trainers import train_popl

SOURCE = """
import gymnasium
import torch
from popl_rl.data.tables import Table
from popl_rl.testing import likes_left, likes_right, tiny_env


class Walk(type(tiny_env())):
    def __init__(self, first=0):
        super().__init__(8)
        self.first = first
        self.action_space = gymnasium.spaces.Discrete(2, start=first)

    def step(self, action):
        assert self.action_space.contains(action), action
        return super().step(action - self.first)

    def transition_table(self):
        table = super().transition_table()
        steps = table.steps.clone()
        steps["action"] += self.first
        return Table(steps, table.next_state, table.terminal, table.start)

    def behaviours(self):
        drift = torch.tensor([[0.3, 0.7]]).repeat(5, 1)
        return {"drift": drift, "pace": self.pace}

    def pace(self, step, generator):
        return step["info", "state"].long() % 2 + self.first


def precise_left(segments):
    return likes_left(segments).double()


def precise_right(segments):
    return likes_right(segments).double()
"""


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "walk.py"
    path.write_text(SOURCE)
    return path


@pytest.fixture
def results(source, tmp_path, config_of, tiny):
    """Train in a folder of its own; what is in ``results.csv``."""

    def run(name, *overrides, groups="popl_rl.testing:likes_left,popl_rl.testing:likes_right"):
        folder = tmp_path / name
        config = config_of(
            *tiny[1:],
            "env=custom",
            f"env.factory={source}:Walk",
            f"raters.groups=[{groups}]",
            "data.segments=80",
            "evaluation.episodes=10",
            f"run_dir={folder}",
            *overrides,
        )
        train_popl.run(config)
        return pd.read_csv(folder / "results.csv")

    return run


def test_random_and_table_behaviours_begin_with_the_first_action(generator):
    drawn = random_behaviour(gymnasium.spaces.Discrete(3, start=2))
    batch = TensorDict({"info": {"next_state": torch.zeros(200).long()}}, [200])
    assert set(drawn(batch, generator).tolist()) == {2, 3, 4}
    table = table_behaviour(torch.tensor([[0.5, 0.5]]), first=7)
    assert set(table(batch, generator).tolist()) == {7, 8}


def test_learners_count_actions_from_0(segments):
    shifted = gymnasium.spaces.Discrete(2, start=1)
    later = segments.clone()
    later["action"] += 1
    assert torch.equal(indexed(later, shifted)["action"], segments["action"])
    assert int(later["action"].min()) == 1
    assert indexed(segments, tiny_env().action_space) is segments


def test_an_environment_that_counts_from_0(source):
    world = make_world(f"{source}:Walk", options={"first": 1})
    env = counting_from_zero(world.make())
    assert env.action_space == gymnasium.spaces.Discrete(2)
    env.reset(seed=0)
    for action in (0, 1):
        env.step(action)


@pytest.mark.parametrize(
    "overrides",
    [[], ["method.learns=reward"], ["method.learns=reward", "evaluation.optimiser=ppo"]],
    ids=["policies", "planned rewards", "optimised rewards"],
)
def test_where_actions_begin_changes_no_result(results, overrides, tmp_path):
    quick = ["evaluation.ppo_frames=200", "method.training.steps=20", *overrides]
    one = results("zero", *quick)
    other = results("one", "+env.options.first=1", *quick)
    pd.testing.assert_frame_equal(one, other, check_exact=True)
    kept = load_tensordict(tmp_path / "one" / "data" / "segments")
    assert kept["action"].unique().tolist() == [1, 2]


@pytest.mark.parametrize("first", [0, 3])
def test_a_set_and_its_actors_act_in_the_environment(source, first, generator):
    """Each step asserts that its action is one of the environment's."""
    world = make_world(f"{source}:Walk", options={"first": first})
    spec = PolicySpec.from_env(world.env, hidden=(4,))
    assert spec.first_action == first
    policies = PolicySet(Population.create(spec, 2, generator=generator))
    env = world.make()
    observation, _ = env.reset(seed=0)
    seen = set()
    for _ in range(8):
        action = policies.act(torch.from_numpy(observation), member=0, generator=generator)
        observation = env.step(int(action))[0]
        seen.add(int(action))
    assert seen == {first, first + 1}
    with torch.random.fork_rng(), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(0)
        wrapped = GymWrapper(world.make(), categorical_action_encoding=True)
        steps = wrapped.rollout(8, policies.actor(1))
    assert steps["action"].unique().tolist() == [first, first + 1]
    old = PolicySet(Population.create(replace(spec, first_action=0), 2, generator=generator))
    for found in (policies, old):  # one of the time before sets knew their environment's actions
        rolled = roll_out(world.make, found, episodes=4, max_steps=8, seed=0)
        assert rolled["action"].unique().tolist() == [first, first + 1]


def test_the_checks_accept_it(source):
    check_env(f"{source}:Walk", first=1)


def test_raters_of_float64_change_no_result(results, source):
    precise = f"{source}:precise_left,{source}:precise_right"
    one, other = results("single"), results("double", groups=precise)
    one["group"] = one["group"].str.replace("likes", "precise")
    pd.testing.assert_frame_equal(one, other, check_exact=True)
