"""What is refused before a run has a folder, though it needs more than the settings to be seen."""

import sys

import pytest
import torch

from popl_rl.experiments import preflight
from popl_rl.trainers import train_popl

MINE = """
import gymnasium
import numpy as np
import torch


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {"speed": 0.0}

    def step(self, action):
        return np.full(2, 0.5, np.float32), 0.0, False, False, {"speed": 1.0}


class Few(Env):
    def collect_segments(self, num_segments, length, *, generator, progress=None):
        from tensordict import TensorDict

        shape = (3, length)
        steps = {"observation": torch.zeros(*shape, 2), "action": torch.zeros(shape)}
        return TensorDict(steps, shape)


class Nan(Env):
    def step(self, action):
        return np.full(2, np.nan, np.float32), 0.0, False, False, {"speed": 1.0}


class Leaves(Env):
    def step(self, action):
        raise SystemExit(0)


def speed(segments):
    return segments["info", "speed"].float()


def leaves(segments):
    raise SystemExit(0)


class Method:
    def __init__(self, problem, **options):
        raise SystemExit(0)
"""
#: Where ``leaves`` does.
LINE = 2 + MINE.splitlines().index("def leaves(segments):")
OWN = ["env=custom", "raters.groups=[mine.py:speed]", "raters.label=return"]


@pytest.fixture
def refused(monkeypatch, tmp_path, capsys, tiny):
    """What a command is refused with: exit code 2, one message, and no folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    (tmp_path / "mine.py").write_text(MINE)

    def call(*overrides):
        small = tiny if "env=custom" not in overrides else tiny[1:]
        monkeypatch.setattr(sys, "argv", ["popl-train", *small, "run_dir=run", *overrides])
        with pytest.raises(SystemExit) as caught:
            train_popl.cli()
        text = "".join(capsys.readouterr())
        assert caught.value.code == 2, text
        assert "Traceback" not in text
        assert sorted(path.name for path in tmp_path.iterdir() if path.name != "__pycache__") == [
            "mine.py"
        ]
        return text[text.index("error:") :]

    return call


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["raters=three_groups"], "'third' has no place here: their door is one of 3 or more"),
        (["env.door=x"], "env.door=x: no such number is in the environment's info, which has door"),
        (["env.measured=[x,goal]"], "env.measured=x: no such number"),
        (["env.success=nope"], "env.success=nope: no such number"),
        (["data.length=21"], "data.length must not exceed the length of an episode"),
        (["data.segments=90000000", "data.length=1000", "env.max_steps=1000"], "GiB; collect few"),
        (["method.popl.selection=lexicaze"], "unknown selection 'lexicaze'"),
        (["method.options.noise=1"], "unexpected keyword argument 'noise'"),
        ([*OWN, "env.factory=mine.py:Few"], "batch size [200, 6], got [3, 6]. ("),
        (
            [*OWN, "env.factory=mine.py:Nan"],
            "step must return finite observations, got [nan nan] (",
        ),
        ([*OWN, "env.factory=mine.py:Leaves"], "step failed with sys.exit(0), which would end the"),
        (
            [*OWN, "env.factory=mine.py:Env", "raters.groups=[mine.py:leaves]"],
            f"mine.py, line {LINE})",
        ),
        (["method.factory=mine.py:Method", "method.reads=[training,refinement]"], "sys.exit(0)"),
        (
            ["method.factory=mine.py:speed", "method.reads=[training,refinement]"],
            "unexpected keyword",
        ),
    ],
)
def test_what_is_refused_leaves_nothing(refused, overrides, said):
    assert said in refused(*overrides)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there(refused):
    assert "device=cuda needs CUDA, which PyTorch" in refused("device=cuda")


def test_a_device_of_a_number_that_is_not_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    preflight.check_device("cuda:1")
    with pytest.raises(ValueError, match="devices are cuda:0 to cuda:1"):
        preflight.check_device("cuda:2")
