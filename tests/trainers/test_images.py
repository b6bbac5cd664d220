"""`popl-train` where observations are images: both groups are told apart by what is seen."""

import pytest

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


@pytest.mark.slow  # a whole run, of several seconds
def test_members_with_convolutions_serve_both_groups(config_of, tiny, tmp_path):
    file = tmp_path / "walk.py"
    file.write_text(WALK)
    config = config_of(
        *tiny[1:],
        "env=custom",
        f"env.factory={file}:Walk",
        f"raters.groups=['{file}:left','{file}:right']",
        "raters.label=return",
        "env.success=",
        "method.channels=[4]",
        "method.hidden=[16]",
        "method.training.steps=200",
        "method.training.learning_rate=0.005",
        "method.refinement.steps=200",
        "raters.answers=30",
        f"run_dir={tmp_path / 'run'}",
    )
    result = run(config)
    board = result.board
    for group in ("left", "right"):
        got, floor = (board.value(method, group, "return") for method in ("popl", "random"))
        assert got > floor + 40  # of some 60
    policies = PolicySet.load(tmp_path / "run" / "policies")
    assert policies.population.spec.image == (8, 8, 3)
    assert policies.population.spec.channels == (4,)
    seen = load_tensordict(tmp_path / "run" / "data" / "segments")["observation"]
    assert policies.act(seen[:5, 0], greedy=True).shape == (len(policies), 5)
