"""Policies that PPO has trained on what groups want: told of before, trained once, and kept."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from popl_rl.config import EnvConfig, PPOSettings
from popl_rl.data.environments import make_world
from popl_rl.experiments.data import build_world
from popl_rl.experiments.ppo_policies import check_ppo, ppo_policies, tell_cost
from popl_rl.trainers import train_popl

LEFT_RIGHT = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]
LINE = EnvConfig(
    factory="popl_rl.testing:tiny_env",
    options={"max_steps": 8},
    max_steps=8,
    ppo=PPOSettings(frames=6000, learning_rate=0.02),
)


def test_each_group_gets_its_own_which_is_trained_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make = build_world(LINE).make
    tell_cost(LINE, LEFT_RIGHT, make)
    said = capsys.readouterr().err
    assert "PPO will train on what popl_rl.testing:likes_left, popl_rl.testing:likes_right" in said
    assert "12000 steps, about" in said
    assert "kept in runs/ppo" in said
    found = ppo_policies(LINE, LEFT_RIGHT, make)
    action = found.act(torch.eye(5).expand(2, 5, 5), greedy=True)
    assert action.tolist() == [[0] * 5, [1] * 5]

    def fail():
        raise AssertionError("what is on disk needs no environment")

    again = ppo_policies(LINE, LEFT_RIGHT[::-1], fail)
    assert torch.equal(again.population(torch.eye(5)).flip(0), found.population(torch.eye(5)))
    tell_cost(LINE, LEFT_RIGHT, fail)
    assert capsys.readouterr().err == ""
    with pytest.raises(AssertionError):  # other settings, another policy
        ppo_policies(replace(LINE, max_steps=7), LEFT_RIGHT, fail)
    assert len(list(Path("runs/ppo").glob("tiny_env-*"))) == 2


def test_a_poor_oracle_shows(tmp_path, monkeypatch, config_of):
    """Trained for a single step, the oracle is nothing to compare with; PPO is."""
    monkeypatch.chdir(tmp_path)
    config = config_of(
        "env=custom",
        "env.factory=popl_rl.testing:tiny_env",
        "env.options.max_steps=8",
        "env.max_steps=8",
        "env.ppo={frames:6000,learning_rate:0.02}",
        f"raters.groups=[{','.join(LEFT_RIGHT)}]",
        "raters.label=return",
        "raters.count=8",
        "raters.answers=2",
        "data={segments:40,length:4}",
        "method.members=2",
        "method.generations=1",
        "method.training={steps:1,learning_rate:1e-6}",
        "method.refinement.steps=0",
        "evaluation={ppo_reference:true,episodes:30,new_raters:2,answers:2,pairs:20,history:0}",
        "evaluation.curve=[]",
        "logger=csv",
        "run_dir=run",
    )
    result = train_popl.run(config)
    for group in ("likes_left", "likes_right"):
        ppo, oracle = (result.board.value(name, group, "return") for name in ("ppo", "oracle"))
        assert ppo > oracle + 1
        assert result.board.value("ppo", group, "share_of_optimum") > 0.7
    assert "its oracle does not act" in Path("run/report.md").read_text()


def test_ppo_has_no_use_where_there_is_nothing_to_do():
    with pytest.raises(ValueError, match=r"evaluation\.ppo_reference must be left out where"):
        check_ppo("evaluation.ppo_reference", make_world("hidden_utility").env)
