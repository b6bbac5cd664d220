"""An environment of one's own on the command line, and what is said where something lacks."""

import sys

import pytest
from omegaconf import OmegaConf

from popl_rl.trainers import train_popl

MINE = """
import gymnasium
import numpy as np
import torch
from walls import LENGTH


class Line(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, places=5):
        self.places = places

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.places // 2
        return np.array([self.place / LENGTH], np.float32), {}

    def step(self, action):
        self.place += 2 * int(action) - 1
        ended = self.place in (0, self.places - 1)
        info = {"right": float(self.place > 0), "ended": float(ended)}
        return np.array([self.place / LENGTH], np.float32), 0.0, ended, False, info


class Guided(gymnasium.Wrapper):
    def behaviours(self):
        return {name: lambda step, generator, to=to: torch.full(step.batch_size, to)
                for name, to in (("go/left", 0), ("go/right", 1))}


def make(places=5):
    return Guided(Line(places))


def left(segments):
    return segments["info", "ended"] - segments["info", "right"]


def right(segments):
    return segments["info", "ended"] * segments["info", "right"]
"""


@pytest.fixture
def own(monkeypatch, tmp_path, capsys):
    """`popl-train` in a folder with a world of one's own: exit code, and what was printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "walls.py").write_text("LENGTH = 10\n")

    def own(*overrides):
        groups = "raters.groups=[mine.py:left,mine.py:right]"
        given = ["env=custom", "env.factory=mine.py:make", groups, *overrides]
        monkeypatch.setattr(sys, "argv", ["popl-train", *given])
        code = 0
        try:
            train_popl.cli()
        except SystemExit as leave:
            code = leave.code
        return code, capsys.readouterr()

    yield own
    sys.modules.pop("walls", None)


def test_options_and_shares_are_given_as_any_other_setting(own, tiny):
    quick = [one for one in tiny if not one.startswith(("env", "raters.groups"))]
    code, said = own(
        *quick,
        "env.options.places=7",
        "env.mixture={go/left:0.25,go/right:0.75}",
        "data.length=2",
        "env.max_steps=8",
        "run_dir=run",
        "raters.label=return",
    )
    assert code == 0, said.err
    kept = OmegaConf.load("run/config.yaml")
    assert kept.env.options == {"places": 7}
    assert kept.env.mixture == {"go/left": 0.25, "go/right": 0.75}


@pytest.mark.parametrize(
    "shares", ["env.mixture.go/left=1", "+env.mixture={go/left:1}", "++env.mixture={go/*:1}"]
)
def test_every_spelling_of_shares_is_read(own, shares):
    code, said = own(shares, "--cfg", "job")
    assert code == 0, said.err
    assert "go/" in said.out[: said.out.index("max_steps")]


def test_who_wants_what_must_be_said(own):
    code, said = own("raters.groups=[]")
    assert code == 2
    assert "such as [my_raters.py:fast," in said.err
    assert "upper" not in said.err
