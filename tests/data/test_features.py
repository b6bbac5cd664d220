"""Frozen feature extractors in the place of what an environment shows."""

import gymnasium
import numpy as np
import pytest
import torch

from popl_rl.config import DataConfig, EnvConfig, PPOSettings
from popl_rl.config.checks import Checker
from popl_rl.data.environments import make_world
from popl_rl.data.features import extractor
from popl_rl.data.rollouts import lockstep
from popl_rl.data.segments import collect_segments
from popl_rl.experiments.data import build_world, describe
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population

FILE = """
import torch


class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.drop = torch.nn.Dropout(0.5)
        self.layer = torch.nn.Linear(147, 4)

    def forward(self, images):
        return self.drop(self.layer(images.flatten(1).float()))


def load():
    return Net()


made = Net()


def means(images):
    return images.float().mean((1, 2))


def halves(images):
    return images[:1].float().flatten(1)


def blind(images):
    raise RuntimeError("cannot see")


def nothing():
    return 7


class Sized(torch.nn.Module):
    def __init__(self, size):
        super().__init__()
"""
IMAGES = torch.arange(2 * 7 * 7 * 3, dtype=torch.uint8).view(2, 7, 7, 3)
GAP = {"factory": "lava_gap", "options": {"view": "partial"}}


@pytest.fixture
def eyes(tmp_path):
    file = tmp_path / "eyes.py"
    file.write_text(FILE)
    return file


@pytest.mark.parametrize("name", ["Net", "load", "made"])
def test_modules_are_frozen_and_the_same_wherever_they_are_made(eyes, name):
    extract = extractor(f"{eyes}:{name}")
    one, two = extract(IMAGES), extract(IMAGES)
    assert one.shape == (2, 4)
    assert torch.equal(one, two)  # no drop-out
    assert not one.requires_grad
    extractor.cache_clear()
    again = extractor(f"{eyes}:{name}")(IMAGES)
    assert torch.equal(one, again)


def test_functions_of_what_is_shown_will_do(eyes):
    extract = extractor(f"{eyes}:means")
    assert torch.equal(extract(IMAGES), IMAGES.float().mean((1, 2)))


def test_segments_rollouts_and_tables_hold_features(eyes):
    world = make_world(**GAP, features=f"{eyes}:means")
    assert world.env.observation_space.shape == (3,)
    assert world.table.horizon is None  # stepped, not looked up
    plain = make_world(**GAP)
    steps, shown = world.table.steps["observation"], plain.table.steps["observation"]
    assert torch.equal(steps, shown.view(*shown.shape[:2], 7, 7, 3).mean((2, 3)))
    segments, images = (
        collect_segments(
            one.make_for_data,
            one.behaviours,
            num_segments=20,
            length=4,
            shares=one.shares,
            max_steps=20,
            generator=torch.Generator().manual_seed(0),
        )
        for one in (world, plain)
    )
    pictures = images["observation"].view(20, 4, 7, 7, 3)
    torch.testing.assert_close(segments["observation"], pictures.mean((2, 3)))
    assert torch.equal(segments["action"], images["action"])  # planners look nothing up in features
    forward = lambda step: torch.full(step.batch_size, 2)  # noqa: E731
    episodes = lockstep([world.make()], forward, seeds=[0], max_steps=5)
    assert episodes["observation"].shape[2:] == (3,)


def test_a_saved_set_acts_on_images_and_says_what_it_misses(eyes, tmp_path):
    world = make_world(**GAP, features=f"{eyes}:means")
    spec = PolicySpec.from_env(world.env, hidden=(8,), channels=(4,))
    assert (spec.features, spec.shown, spec.image) == (f"{eyes}:means", (7, 7, 3), ())
    generator = torch.Generator().manual_seed(0)
    PolicySet(Population.create(spec, 3, generator=generator)).save(tmp_path / "set")
    policies = PolicySet.load(tmp_path / "set")
    read = policies.population.spec.seen(IMAGES)
    assert torch.equal(read, IMAGES.float().mean((1, 2)))
    action = policies.act(IMAGES, greedy=True)
    assert torch.equal(action, policies.act(read, greedy=True))
    with pytest.raises(ValueError, match=r"shape \[..., 7, 7, 3\]"):
        policies.act(IMAGES[:, :5], greedy=True)
    eyes.unlink()
    extractor.cache_clear()
    with pytest.raises(ValueError, match=r"whose extractor cannot be found.*Bring it back"):
        PolicySet.load(tmp_path / "set").act(IMAGES, greedy=True)
    assert torch.equal(action, PolicySet.load(tmp_path / "set").act(read, greedy=True))


def test_an_extractor_that_has_changed_is_refused(eyes, tmp_path):
    spec = PolicySpec(5, 3, True, (4,), features=f"{eyes}:means", shown=(7, 7, 3))
    with pytest.raises(ValueError, match=r"must be 5 numbers.*got 3"):
        spec.seen(IMAGES)


def test_settings_name_it_and_stored_data_know_it(eyes, tmp_path):
    def config(**more):
        return EnvConfig(**GAP, success="", ppo=PPOSettings(frames=100), **more)

    with_eyes = config(features=f"{eyes}:means")
    assert build_world(with_eyes).env.observation_space.shape == (3,)
    data = DataConfig()
    plain, seen = (describe(one, data, seed=0) for one in (config(), with_eyes))
    assert "features" not in plain["env"]
    assert seen["env"]["features"] == f"{eyes}:means"
    assert "eyes.py" in seen["plug_ins"]  # whose digest changes with the file
    problems = []
    config(features="extract").check(Checker("env", problems))
    (problem,) = problems
    assert "env.features must be a reference" in problem


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("nowhere", ValueError, "has no 'nowhere'"),
        ("halves", TypeError, r"shape \[2, F\]"),
        ("blind", ValueError, "reading observations failed with RuntimeError: cannot see"),
        ("nothing", TypeError, "must return a torch.nn.Module, got int"),
        ("Sized", ValueError, "making it failed with TypeError"),
    ],
)
def test_what_extractors_may_not_do(eyes, name, error, message):
    with pytest.raises(error, match=message):
        extractor(f"{eyes}:{name}")(IMAGES)


def test_only_boxes_have_features(eyes):
    with pytest.raises(TypeError, match="observations that are a Box, got Discrete"):
        make_world("gymnasium:make", env_id="FrozenLake-v1", features=f"{eyes}:means")


class Gatherer(gymnasium.Env):
    """Collects segments itself."""

    observation_space = gymnasium.spaces.Box(0, 255, (7, 7, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def collect_segments(self, num_segments, length, *, generator, progress=None):
        raise NotImplementedError


def test_environments_that_collect_segments_give_features_themselves(eyes):
    with pytest.raises(ValueError, match=r"env\.features must be left out"):
        make_world(f"{__name__}:Gatherer", features=f"{eyes}:means")
