"""The check of an environment."""

import contextlib
import math

import gymnasium
import numpy as np
import pytest
import torch

from popl_rl import registry
from popl_rl.data.tables import Table
from popl_rl.testing import check_env, check_rater, likes_left, tiny_env

Box, Discrete = gymnasium.spaces.Box, gymnasium.spaces.Discrete
Good = type(tiny_env())


class Broken(Good):
    """A tiny environment in which one thing is replaced."""

    def __init__(self, **replaced):
        super().__init__(max_steps=20)
        for name, value in replaced.items():
            setattr(self, name, value)

    def reset(self, *, seed=None, options=None):
        answer = super().reset(seed=seed, options=options)
        return self.change_reset(*answer)

    def step(self, action):
        return self.change_step(*super().step(action))

    def change_reset(self, *answer):
        return answer

    def change_step(self, *answer):
        return answer


def stepping(**changed):
    """An environment whose steps answer with something else, or a function of what they should."""
    fields = ("observation", "reward", "terminated", "truncated", "info")

    def change(*answer):
        wrong = [changed.get(field, value) for field, value in zip(fields, answer, strict=True)]
        return tuple(
            new(old) if callable(new) else new for new, old in zip(wrong, answer, strict=True)
        )

    return lambda: Broken(change_step=change)


def with_table(change):
    def make():
        env = Broken()
        table = env.transition_table()
        env.transition_table = lambda: change(table)
        return env

    return make


def replaced_row(key, value):
    def change(table):
        steps = table.steps.clone()
        steps[key][:] = value
        return Table(steps, table.next_state, table.terminal, table.start)

    return with_table(change)


class Unseeded(Good):
    def reset(self, **_):
        return super().reset()


class OneBuffer(Good):
    """Writes every observation into the same array."""

    def __init__(self):
        super().__init__(max_steps=20)
        self.buffer = np.zeros(5, dtype=np.float32)

    def _observation(self):
        self.buffer[:] = super()._observation()
        return self.buffer


class Failing(Good):
    def step(self, _):
        raise RuntimeError("the motor is stuck")


def functional(step, generator):
    """Acts by observations and by all that is told at a reset."""
    info, drawn = step["info", "state"], torch.rand(len(step), generator=generator)
    return ((step["observation"][:, 0] + drawn + info) > 1).long()


class Remembering:
    """Goes on with what it began in each episode of a batch."""

    def reset(self):
        self.begun = None

    def __call__(self, step, generator):
        if self.begun is None:
            self.begun = torch.randint(2, (len(step),), generator=generator)
        return self.begun.clone()


def by_the_speed(step, generator):
    return step["info", "speed"].long()


class Behaving(Good):
    def __init__(self, found):
        super().__init__(max_steps=20)
        self.found = found

    def behaviours(self):
        return self.found


BROKEN_ENVS = {
    "not an env": (lambda: 3, TypeError, "must return a gymnasium.Env, got a int; subclass"),
    "fails to be made": (lambda: 1 / 0, ValueError, "making it failed with ZeroDivisionError"),
    "shifted actions": (
        lambda: Broken(action_space=Discrete(2, start=1)),
        ValueError,
        "column a of transition_table.*'action' must be the environment's action 1 . a",
    ),
    "unbounded actions": (
        lambda: Broken(action_space=Box(-np.inf, np.inf, (2,))),
        ValueError,
        "must be bounded where there are no behaviours.*give it low and high",
    ),
    "reset without info": (
        lambda: Broken(change_reset=lambda observation, _: observation),
        TypeError,
        r"reset must return \(observation, info\), got a ndarray",
    ),
    "old step": (
        lambda: Broken(change_step=lambda *answer: answer[:4]),
        TypeError,
        r"step must return \(observation, reward.*got 4 values",
    ),
    "fails in a step": (
        lambda: Failing(20),
        ValueError,
        "step failed with RuntimeError: the motor is stuck",
    ),
    "NaN observation": (
        stepping(observation=lambda o: o * np.float32("nan")),
        ValueError,
        "observations must be finite",
    ),
    "other shape": (
        stepping(observation=lambda o: o[:4]),
        ValueError,
        r"must have the shape \(5,\) of the space, got \(4,\)",
    ),
    "no number as reward": (
        stepping(reward=None),
        TypeError,
        "reward must be a number, got a NoneType",
    ),
    "NaN reward": (
        stepping(reward=math.nan),
        ValueError,
        "reward must be finite",
    ),
    "truncated is no bool": (
        stepping(truncated=None),
        TypeError,
        "truncated must be a bool, got a NoneType",
    ),
    "info is no dict": (
        stepping(info=[]),
        TypeError,
        "info must be a dict, got a list",
    ),
    "info is NaN": (
        stepping(info=lambda i: {**i, "state": math.nan}),
        ValueError,
        r"info\['state'\] must be finite, got nan",
    ),
    "no table": (with_table(lambda _: None), TypeError, "Table, got a NoneType"),
    "other actions": (
        lambda: Broken(action_space=Discrete(3)),
        ValueError,
        "lists 2 actions, but action_space is Discrete.3.",
    ),
    "info without state": (
        lambda: Broken(
            change_reset=lambda o, _: (o, {}), change_step=lambda *answer: (*answer[:4], {})
        ),
        ValueError,
        r"info must hold 'state' and 'next_state'.*info has \[\]",
    ),
    "state after the step": (
        stepping(info=lambda i: {**i, "state": i["next_state"]}),
        ValueError,
        r"info\['state'\] must be the state before the step",
    ),
    "wrong next state": (
        with_table(lambda t: Table(t.steps, t.next_state.flip(1), t.terminal, t.start)),
        ValueError,
        "must agree with stepping, but next_state is .*build both",
    ),
    "wrong terminal": (
        with_table(lambda t: Table(t.steps, t.next_state, ~t.terminal, t.start)),
        ValueError,
        "terminal is True at state .* it was False",
    ),
    "wrong start": (
        with_table(lambda t: Table(t.steps, t.next_state, t.terminal, torch.eye(5)[2])),
        ValueError,
        "start gives no probability to the first state",
    ),
    "wrong reward": (replaced_row("reward", 3.0), ValueError, "reward is 3 at .* got 0"),
    "wrong observation": (
        replaced_row("observation", 0.0),
        ValueError,
        "observation of state . is not the one seen",
    ),
    "wrong info": (
        replaced_row(("info", "next_state"), 9),
        ValueError,
        "info 'next_state' is 9 at state",
    ),
    "behaviours are no dict": (lambda: Behaving([]), TypeError, "must return a dict.*got list"),
    "no behaviours": (lambda: Behaving({}), TypeError, "at least one name"),
    "behaviour is no policy": (
        lambda: Behaving({"odd": torch.zeros(5, 2).long()}),
        TypeError,
        "behaviour 'odd' must be a float tensor.*got torch.int64",
    ),
    "behaviour is no distribution": (
        lambda: Behaving({"odd": torch.ones(5, 2)}),
        ValueError,
        "row of behaviour 'odd'.*softmax",
    ),
    "behaviour gives fractions": (
        lambda: Behaving({"own": functional, "odd": lambda step, _: torch.zeros(len(step))}),
        TypeError,
        r"behaviour 'odd' must return whole numbers \[3\], got torch.float32",
    ),
    "behaviour gives one action": (
        lambda: Behaving({"odd": lambda *_: torch.zeros(1).long()}),
        TypeError,
        r"behaviour 'odd' must return whole numbers \[3\], got torch.int64 of shape \[1\]",
    ),
    "behaviour leaves the space": (
        lambda: Behaving({"odd": lambda step, _: torch.full((len(step),), 2)}),
        ValueError,
        r"behaviour 'odd' must return actions in 0\.\.1, got 2\.\.2",
    ),
    "behaviour takes one argument": (
        lambda: Behaving({"odd": lambda step: torch.zeros(len(step)).long()}),
        ValueError,
        "behaviour 'odd' failed with TypeError",
    ),
    "behaviour reads what no reset tells": (
        lambda: Behaving({"odd": by_the_speed}),
        ValueError,
        """behaviour 'odd' failed with KeyError.*"speed" not found""",
    ),
}


@pytest.mark.parametrize(("make", "error", "message"), BROKEN_ENVS.values(), ids=BROKEN_ENVS.keys())
def test_each_fault_of_an_environment_is_found(make, error, message):
    with pytest.raises(error, match=message):
        check_env(make)


class Blind(gymnasium.Env):
    """Gives samples of its space."""

    def __init__(self, observation_space=None, action_space=None):
        self.observation_space = observation_space or Box(0, 1, (5,), np.float32)
        self.action_space = action_space or Discrete(2)

    def reset(self, *, seed=None, options=None):  # noqa: ARG002 - Gymnasium's name
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 0.0, False, False, {"late": 1.0}


#: What training takes as it is, and so does the check.
TAKEN = {
    "float64 space": lambda: Blind(Box(0, 1, (5,), np.float64)),
    "dict observations": lambda: Blind(gymnasium.spaces.Dict({"a": Discrete(3), "b": Box(0, 1)})),
    "many actions at once": lambda: Blind(action_space=gymnasium.spaces.MultiDiscrete([2, 2])),
    "list observation": stepping(observation=lambda o: o.tolist()),
    "float64 observation": stepping(observation=lambda o: o.astype(float)),
    "one buffer": OneBuffer,
    "info changes keys": stepping(info=lambda i: {**i, "further": [1, 2]}),
}


@pytest.mark.parametrize("make", TAKEN.values(), ids=TAKEN.keys())
def test_what_training_takes_is_no_fault(make):
    check_env(make, num_steps=20)


WARNED = {
    "outside the space": (
        stepping(observation=lambda o: o * 7),
        "should lie in Box.*values from 0 to 7.*correct the space",
    ),
    "terminated is a number": (stepping(terminated=0), "TorchRL's check_env_specs failed"),
    "behaviour by other chance": (
        lambda: Behaving({"odd": lambda step, _: torch.randint(2, (len(step),))}),
        "behaviour 'odd' should take the same actions.*draw from the generator alone",
    ),
    "unseeded": (lambda: Unseeded(20), "same seed and actions.*self.np_random only"),
}


@pytest.mark.filterwarnings("default::UserWarning")
@pytest.mark.parametrize(("make", "message"), WARNED.values(), ids=WARNED.keys())
def test_what_training_does_not_mind_is_a_warning(make, message):
    with pytest.warns(UserWarning, match=message), contextlib.suppress(ValueError):
        check_env(make)


def test_what_torchrl_refuses_is_reported(monkeypatch):
    def refuse(env):
        raise AssertionError("specs differ")

    monkeypatch.setattr("popl_rl.testing.env_parts.check_env_specs", refuse)
    with pytest.warns(UserWarning, match="failed with AssertionError: specs differ"):
        check_env(tiny_env)


def test_an_environment_can_be_given_in_three_ways():
    check_env(tiny_env)
    check_env(tiny_env())
    check_env("popl_rl.testing:tiny_env", max_steps=3)
    check_env(
        lambda: Behaving({"left": torch.eye(2)[[0] * 5], "own": functional, "mind": Remembering()})
    )
    with pytest.raises(TypeError, match="or a reference to it, got a int"):
        check_env(3)
    with pytest.raises(TypeError, match="takes no arguments"):
        check_env(tiny_env(), max_steps=3)


def test_an_environment_of_another_author():
    make = lambda: gymnasium.make("Pendulum-v1")  # noqa: E731
    check_env(make)
    check_rater(lambda segments: -segments["action"].square().sum(-1), make)


def test_checking_leaves_the_global_randomness_alone():
    before = torch.random.get_rng_state()
    check_env(tiny_env)
    check_rater(likes_left)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_importing_registers_nothing():
    assert "tiny_env" not in registry.names("env")
    assert "likes_left" not in registry.names("rater")
