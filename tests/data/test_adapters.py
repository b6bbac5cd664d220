"""An environment of every kind of space, as learners take it."""

# ruff: noqa: ARG002, ARG005 - Gymnasium's names of arguments

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs import PendulumEnv, SerialEnv

from popl_rl import registry
from popl_rl.data.adapters import adapted, as_gymnasium, observation_names
from popl_rl.data.environments import make_world
from popl_rl.data.segments import collect_segments
from popl_rl.evaluation.acting import Rolling
from popl_rl.models.policies import PolicySpec

PARTS = spaces.Dict(
    {
        "pose": spaces.Box(-1.0, 1.0, (2, 2), np.float64),
        "door": spaces.Discrete(3, start=1),
        "lamps": spaces.MultiBinary(2),
        "words": spaces.Text(8),
        "both": spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 255, (1,), np.uint8))),
    }
)


class Any(gymnasium.Env):
    """Gives samples of a space, and keeps the actions that it was told."""

    def __init__(self, seen=None, acts=None, behaviours=None):
        self.observation_space = seen or spaces.Box(0.0, 1.0, (2,), np.float32)
        self.action_space = acts or spaces.Discrete(2)
        self.told = []
        if behaviours is not None:
            self.behaviours = lambda: behaviours

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.told.append(action)
        return self.observation_space.sample(), 1.0, False, len(self.told) % 6 == 0, {"one": 1}


SEEN = {
    "flat": (spaces.Box(0.0, 1.0, (2,), np.float32), 2),
    "float64": (spaces.Box(0.0, 1.0, (3,), np.float64), 3),
    "image": (spaces.Box(0, 255, (4, 4, 3), np.uint8), 48),
    "number": (spaces.Box(0.0, 1.0, (), np.float32), 1),
    "choice": (spaces.Discrete(4, start=2), 4),
    "lamps": (spaces.MultiBinary((2, 3)), 6),
    "choices": (spaces.MultiDiscrete([2, 3]), 5),
    "parts": (PARTS, 4 + 3 + 2 + 2 + 1),
    "tuple": (spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (3,)))), 5),
}
ACTS = {
    "discrete": (spaces.Discrete(3), 3),
    "discrete from 1": (spaces.Discrete(3, start=1), 3),
    "choices": (spaces.MultiDiscrete([2, 3]), 6),
    "choices from 1": (spaces.MultiDiscrete([2, 2], start=[1, 5]), 4),
    "lamps": (spaces.MultiBinary(3), 8),
    "box": (spaces.Box(-1.0, 1.0, (2, 2), np.float32), 4),
    "float64 box": (spaces.Box(-1.0, 1.0, (2,), np.float64), 2),
}


def world_of(**given):
    with registry.isolated():
        registry.env("any")(lambda: Any(**given))
        return make_world("any")


def collected(world):
    return collect_segments(
        world.make_for_data,
        world.behaviours,
        num_segments=6,
        length=3,
        generator=torch.Generator().manual_seed(0),
        shares=world.shares,
        max_steps=6,
        num_envs=2,
    )


@pytest.mark.parametrize(("space", "size"), SEEN.values(), ids=SEEN.keys())
def test_any_observation_is_a_vector_whose_numbers_have_names(space, size):
    world = world_of(seen=space)
    assert PolicySpec.from_env(world.env).observation_dim == size
    segments = collected(world)
    assert segments["observation"].shape == (6, 3, size)
    assert segments["observation"].dtype == torch.float32
    names = observation_names(space)
    assert len(names) == len(set(names)) == size


@pytest.mark.parametrize(("space", "size"), ACTS.values(), ids=ACTS.keys())
def test_any_action_is_one_choice_or_one_vector(space, size):
    world = world_of(acts=space)
    spec = PolicySpec.from_env(world.env)
    assert spec.action_dim == size
    action = collected(world)["action"]
    assert action.shape == ((6, 3) if spec.discrete else (6, 3, size))


def test_parts_are_where_their_names_say():
    space = spaces.Dict({"a": PARTS["door"], "b": PARTS["pose"], "c": PARTS["both"]})
    assert observation_names(space) == [
        *("a=1", "a=2", "a=3"),
        *("b[0,0]", "b[0,1]", "b[1,0]", "b[1,1]"),
        *("c.0=0", "c.0=1", "c.1[0]"),
    ]
    flat = spaces.flatten(space, {"a": 2, "b": np.arange(4.0).reshape(2, 2), "c": (1, [7])})
    assert flat.tolist() == [0, 1, 0, 0, 1, 2, 3, 0, 1, 7]


def test_numbers_of_actions_and_behaviours_mean_what_the_environment_takes():
    """Of choices in {1, 2} and {5, 6, 7}, number 4 is the second and the middle one."""
    space = spaces.MultiDiscrete([2, 3], start=[1, 5])
    inner = Any(acts=space)
    env = adapted(inner)
    env.reset(seed=0)
    env.step(4)
    assert inner.told[0].tolist() == [2, 6]
    native = {"fixed": lambda step, generator: torch.tensor([[2, 6]]).expand(len(step), 2)}
    assert (collected(world_of(acts=space, behaviours=native))["action"] == 4).all()
    square = {"fixed": lambda step, generator: torch.eye(2).expand(len(step), 2, 2)}
    box = spaces.Box(-1.0, 1.0, (2, 2), np.float32)
    action = collected(world_of(acts=box, behaviours=square))["action"]
    assert action[0, 0].tolist() == [1, 0, 0, 1]


def test_actions_without_bounds_need_behaviours():
    space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    with pytest.raises(TypeError, match="must be Discrete or a bounded Box"):
        world_of(acts=space)
    gait = {"gait": lambda step, generator: torch.full((len(step), 2), 3.0)}
    world = world_of(acts=space, behaviours=gait)
    assert (collected(world)["action"] == 3).all()
    rolled = Rolling(world, episodes=2, max_steps=3, seed=0)(None)
    assert rolled["action"].std() > 0.1


def test_what_cannot_be_adapted_is_told():
    with pytest.raises(ValueError, match="at most 1024 combinations, got 4096"):
        world_of(acts=spaces.MultiBinary(12))
    with pytest.raises(TypeError, match="must be Discrete, MultiDiscrete, MultiBinary or Box"):
        world_of(acts=spaces.Tuple((spaces.Discrete(2),)))
    with pytest.raises(TypeError, match="observations must be numbers"):
        world_of(seen=spaces.Sequence(spaces.Discrete(2)))


def test_minigrids_image_and_direction_are_read_and_its_mission_left_out():
    env = make_world("gymnasium:make", env_id="MiniGrid-LavaGapS5-v0").env
    assert env.observation_space.shape == (7 * 7 * 3 + 4,)


def test_an_environment_of_torchrl():
    with registry.isolated():
        registry.env("pendulum")(PendulumEnv)
        world = make_world("pendulum")
    spec = PolicySpec.from_env(world.env)
    assert (spec.discrete, spec.action_dim) == (False, 1)
    segments = collected(world)
    assert segments["observation"].shape == (6, 3, 8)
    assert (segments["reward"] < 0).any()
    with pytest.raises(ValueError, match=r"no batch size, got \[2\]"):
        as_gymnasium(SerialEnv(2, PendulumEnv))
