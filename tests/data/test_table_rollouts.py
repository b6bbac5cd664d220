"""Episodes looked up in a table are those of stepping, to the bit."""

from functools import partial

import gymnasium
import pytest
import torch

from popl_rl.data.environments import make_world
from popl_rl.data.rollouts import MASK, lockstep
from popl_rl.data.table_rollouts import Rollouts, table_lockstep
from popl_rl.data.tables import Table
from popl_rl.envs.two_doors import two_doors
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.testing import tiny_env

SEEDS = [3, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8] * 2  # the same seed, the same start

WORLDS = [
    ("two_doors", {"size": 7}),
    ("two_doors", {"start": "mixed", "doors": 3, "max_steps": 9}),
    ("goal_grid", {"size": 4, "goals": 3}),
    ("delivery", {}),
    ("popl_rl.testing:tiny_env", {}),
    ("popl_rl.envs.example:Exits", {}),
]


def stepped(make, act, seeds, max_steps):
    return lockstep([make() for _ in seeds], act, seeds=seeds, max_steps=max_steps)


def drawn(behaviour, generator, step):
    return behaviour(step, generator)


def always_one(step):
    return torch.ones(step.batch_size, dtype=torch.int64)


def assert_equal(one, other):
    assert one.batch_size == other.batch_size
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert one[key].dtype == other[key].dtype, key
        assert torch.equal(one[key], other[key]), key


@pytest.mark.parametrize(("factory", "options"), WORLDS)
@pytest.mark.parametrize("max_steps", [4, 40])
def test_every_behaviour_walks_as_if_stepped(factory, options, max_steps):
    world = make_world(factory, options=options)
    with Rollouts(world.make) as roll:
        assert roll.table is not None
        for name, behaviour in world.behaviours.items():
            episodes = []
            for way in (roll, lambda act, **how: stepped(world.make, act, **how)):
                if hasattr(behaviour, "reset"):
                    behaviour.reset()
                act = partial(drawn, behaviour, torch.Generator().manual_seed(0))
                episodes.append(way(act, seeds=SEEDS, max_steps=max_steps))
            assert_equal(*episodes)
            assert episodes[0][MASK].any(), name


def test_policies_walk_as_if_stepped():
    world = make_world("two_doors")
    draws = torch.Generator().manual_seed(0)
    policies = PolicySet(Population.create(PolicySpec.from_env(world.env), 2, generator=draws))

    def roll(way):
        generator = torch.Generator().manual_seed(1)

        def act(step):
            observation = step["observation"].view(2, len(SEEDS) // 2, -1)
            return policies.act(observation, generator=generator).flatten()

        return way(act)

    with Rollouts(world.make) as rollouts:
        found = roll(lambda act: rollouts(act, seeds=SEEDS, max_steps=60))
    assert_equal(found, roll(lambda act: stepped(world.make, act, SEEDS, 60)))


def test_an_environment_is_never_stepped_where_its_table_answers():
    class Stubborn(type(two_doors())):
        def step(self, _):
            raise AssertionError("stepped")

    with Rollouts(Stubborn) as roll:
        episodes = roll(always_one, seeds=[0], max_steps=5)
    assert episodes[MASK].sum() == 5


class NoHorizon(type(two_doors())):
    def transition_table(self):
        table = super().transition_table()
        return Table(table.steps, table.next_state, table.terminal, table.start)


@pytest.mark.parametrize(
    "make",
    [
        NoHorizon,
        # A wrapper may change what a step gives, and the table below does not know.
        lambda: gymnasium.wrappers.TransformReward(two_doors(), lambda reward: 2 * reward),
        lambda: gymnasium.make("CartPole-v1"),
    ],
)
def test_others_are_stepped(make):
    with Rollouts(make) as roll:
        assert roll.table is None
        found = roll(always_one, seeds=[0, 1], max_steps=5)
    assert_equal(found, stepped(make, always_one, seeds=[0, 1], max_steps=5))


def test_what_does_not_fit_is_refused():
    env = tiny_env()
    table = env.transition_table()
    shifted = Table(
        table.steps.clone().update({"observation": table.steps["observation"] + 1}),
        table.next_state,
        table.terminal,
        table.start,
        horizon=20,
    )

    def act(step):
        return torch.full(step.batch_size, 2)

    with pytest.raises(ValueError, match=r"actions must be from 0 to 1, got \[2\]"):
        table_lockstep(env, table, act, seeds=[0], max_steps=3)
    with pytest.raises(ValueError, match="must list the observations that reset returns"):
        table_lockstep(env, shifted, act, seeds=[0], max_steps=3)
    for seeds, max_steps, message in ([0], 0, "max_steps must be"), ([], 1, "seeds must hold"):
        with pytest.raises(ValueError, match=message):
            table_lockstep(env, table, act, seeds=seeds, max_steps=max_steps)
    with pytest.raises(ValueError, match="horizon must be at least 1, got 0"):
        Table(table.steps, table.next_state, table.terminal, table.start, horizon=0)
