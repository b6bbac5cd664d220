"""`popl-train` where observations are images: both groups are told apart by what is seen."""

import pytest
import torch

from popl_rl.models.policy_set import PolicySet
from popl_rl.storage import load_tensordict
from popl_rl.trainers.train_popl import run

WALK = """
import gymnasium
import numpy as np


class Walk(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)  # left, right

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(8))
        return self.picture(), {"place": self.place}

    def step(self, action):
        self.place = min(max(self.place + 2 * int(action) - 1, 0), 7)
        return self.picture(), 0.0, False, False, {"place": self.place}

    def picture(self):
        pixels = np.zeros((8, 8, 3), np.uint8)
        pixels[3:5, self.place, :2] = 255
        return pixels


def left(segments):
    return -segments["info", "place"].float()


def right(segments):
    return segments["info", "place"].float()
"""


EXTRACT = """
import torch


class Rows(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(8, 6)

    def forward(self, images):
        assert images.dtype == torch.uint8 and images.shape[1:] == (8, 8, 3)
        return self.layer(images[:, 3, :, 0] / 255)
"""


@pytest.fixture
def walk(tiny, tmp_path):
    """Overrides for a run on pictures of a walk, in which two groups want opposite ends."""
    file = tmp_path / "walk.py"
    file.write_text(WALK)
    return [
        *tiny[1:],
        "env=custom",
        f"env.factory={file}:Walk",
        f"raters.groups=['{file}:left','{file}:right']",
        "raters.label=return",
        "env.success=",
        "method.hidden=[16]",
        "method.training.steps=200",
        "method.training.learning_rate=0.005",
        "method.refinement.steps=200",
        "raters.answers=30",
        f"run_dir={tmp_path / 'run'}",
    ]


def assert_serves_both(board):
    """Either group gets most of what there is beyond random actions."""
    for group in ("left", "right"):
        got, floor = (board.value(method, group, "return") for method in ("popl", "random"))
        assert got > floor + 40  # of some 60


@pytest.mark.slow  # a whole run, of several seconds
def test_members_with_convolutions_serve_both_groups(config_of, walk, tmp_path):
    assert_serves_both(run(config_of(*walk, "method.channels=[4]")).board)
    policies = PolicySet.load(tmp_path / "run" / "policies")
    assert policies.population.spec.image == (8, 8, 3)
    assert policies.population.spec.channels == (4,)
    seen = load_tensordict(tmp_path / "run" / "data" / "segments")["observation"]
    assert policies.act(seen[:5, 0], greedy=True).shape == (len(policies), 5)


@pytest.mark.slow  # a whole run, of several seconds
def test_members_act_on_features_and_serve_both_groups(config_of, walk, tmp_path):
    (tmp_path / "eyes.py").write_text(EXTRACT)
    assert_serves_both(run(config_of(*walk, f"env.features={tmp_path / 'eyes.py'}:Rows")).board)
    seen = load_tensordict(tmp_path / "run" / "data" / "segments")["observation"]
    assert seen.shape[2:] == (6,)  # segments hold features alone
    policies = PolicySet.load(tmp_path / "run" / "policies")
    assert policies.population.spec.shown == (8, 8, 3)
    assert not policies.population.spec.image
    images = torch.zeros(8, 8, 8, 3, dtype=torch.uint8)  # the walker in each of the eight places
    for place in range(8):
        images[place, 3:5, place, :2] = 255
    features = policies.population.spec.seen(images)
    shown = torch.cat([features, seen.flatten(0, 1)]).unique(dim=0)
    assert len(shown) <= 9  # the same eight features as in the data, and padding at most
    greedy = policies.act(images, greedy=True)
    assert torch.equal(greedy, policies.act(features, greedy=True))
    assert greedy.shape == (len(policies), 8)
    assert policies.act(images[0], member=0, greedy=True).shape == ()
