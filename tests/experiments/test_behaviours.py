"""What the data show, by reference: functions, saved policies, PPO, random actions, with noise."""

from dataclasses import replace
from pathlib import Path

import gymnasium
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import nn

from popl_rl.config import DataConfig, EnvConfig, PPOSettings
from popl_rl.data.environments import World
from popl_rl.experiments.behaviours import chosen_behaviours, policy_digests
from popl_rl.experiments.data import build_world, describe
from popl_rl.experiments.plug_ins import find_plug_ins, keep_plug_ins
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population

LINE = EnvConfig(factory="popl_rl.testing:tiny_env", max_steps=8, ppo=PPOSettings(frames=100))
WAYS = """
import torch
from popl_rl.models.policies import PolicySpec, build_actor


def leftwards(step, generator):
    return torch.zeros(step.batch_size, dtype=torch.long)


def likes_left(segments):
    return 1 - segments["info", "next_state"] / 4


layer = torch.nn.Linear(5, 2)
torch.nn.init.zeros_(layer.weight)
layer.bias.data = torch.tensor([0.0, 1.0])
actor = build_actor(PolicySpec(5, 2, True, ()), torch.nn.Sequential(layer))
wrong = lambda step, generator: torch.full(step.batch_size, 7)
"""
STEP = TensorDict({"observation": torch.eye(5)[:4].repeat(50, 1)}, [200])


@pytest.fixture(autouse=True)
def own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("ways.py").write_text(WAYS)


def walkers(*biases, inputs=5):
    networks = [nn.Sequential(nn.Linear(inputs, 2)) for _ in biases]
    for network, bias in zip(networks, biases, strict=True):
        nn.init.zeros_(network[0].weight)
        network[0].bias.data = torch.tensor([0.0, bias])
    return PolicySet(Population(networks, PolicySpec(inputs, 2, True, ())))


def right_share(world, name):
    action = world.behaviours[name](STEP, torch.Generator().manual_seed(0))
    return float(action.float().mean())


def test_every_kind_of_behaviour_acts_at_every_level_of_noise():
    walkers(-30.0, 30.0).save("runs/mine/policies")
    world = build_world(
        replace(
            LINE,
            behaviours=[
                "ways.py:leftwards",
                "ways.py:actor",
                "policy:runs/mine/policies",
                "random",
            ],
            noise=[0.0, 0.5],
            mixture={"leftwards*": 0.5, "random": 0.25, "policy:*": 0.25},
        )
    )
    right = {name: right_share(world, name) for name in world.behaviours}
    assert {name: share for name, share in right.items() if share in (0, 1)} == {
        "leftwards": 0,
        "actor": 1,
        "policy:mine#0": 0,
        "policy:mine#1": 1,
    }
    # Half of the actions are drawn, and half of these are the other one.
    noisy = [right[f"{name}~0.5"] for name in ("leftwards", "policy:mine#0")]
    assert noisy == pytest.approx([0.25, 0.25], abs=0.1)
    assert right["random"] == pytest.approx(0.5, abs=0.1)
    assert "random~0.5" not in right
    assert world.shares["leftwards~0.5"] == 0.25
    assert world.shares["policy:mine#0"] == 0.0625


def test_a_member_ppo_and_what_decides_about_segments():
    walkers(-30.0, 30.0).save("set")
    env = replace(LINE, behaviours=["policy:set#1", "ppo:ways.py:likes_left"])
    world = build_world(env)
    assert list(world.behaviours) == ["policy:set#1", "ppo:likes_left"]
    assert not Path("runs").exists()  # nothing is trained before it is needed
    right_share(world, "ppo:likes_left")
    assert Path("runs/ppo").exists()
    about = describe(env, DataConfig(), seed=0)
    assert about["env"]["policies"] == policy_digests(env)
    assert about["env"]["ppo"]["frames"] == 100
    assert list(about["plug_ins"]) == ["ways.py"]
    assert "behaviours" not in describe(LINE, DataConfig(), seed=0)["env"]


def test_a_run_keeps_the_file_of_the_raters_that_ppo_is_trained_on():
    config = OmegaConf.create({"behaviours": ["ppo:ways.py:likes_left", "random"]})
    kept = keep_plug_ins(Path("run"), config)
    Path("ways.py").unlink()
    [reference, _] = find_plug_ins(Path("run"), config, kept).behaviours
    assert reference.startswith("ppo:/")
    assert reference.endswith("/plug_ins/0/ways.py:likes_left")


def test_noise_on_vectors_is_gaussian_in_halves_of_their_range():
    class Box(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 1, (5,))
        action_space = gymnasium.spaces.Box(0.0, 4.0, (2,))

    still = {"still": lambda step, _: torch.full((*step.batch_size, 2), 2.0)}
    made = chosen_behaviours(replace(LINE, noise=[0.25]), World(Box, Box, Box(), still, {}, None))
    action = made["still~0.25"](STEP, torch.Generator().manual_seed(0))
    assert float(action.mean()) == pytest.approx(2.0, abs=0.1)
    assert float(action.std()) == pytest.approx(0.25 * 2, rel=0.15)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"behaviours": ["gait"]}, r"unknown behaviour 'gait'"),
        ({"behaviours": ["ways.py:gait"]}, r"ways\.py has no 'gait'.* leftwards"),
        ({"behaviours": ["ppo:gait"]}, r"unknown rater 'gait'"),
        ({"behaviours": ["policy:nowhere"]}, r"policy:nowhere' must name the folder of a policy"),
        ({"behaviours": ["policy:empty"]}, r"env.behaviours: 'policy:empty': "),
        ({"behaviours": ["policy:set#2"]}, r"'policy:set#2' must name one of members 0 to 1"),
        ({"behaviours": ["policy:other"]}, r"policy:other' is of .*observation_dim=3"),
        ({"behaviours": ["policy:sb.zip"]}, r"pip install stable-baselines3|cannot be read"),
        ({"behaviours": ["set", "policy:set"]}, r"unknown behaviour 'set'"),
        ({"behaviours": ["policy:set#1", "policy:set"]}, r"a second behaviour 'policy:set#1'"),
        ({"noise": [2.0]}, r"env\.noise must be chances in \[0, 1\]"),
        ({"behaviours": ["random"], "mixture": {"gait": 1.0}}, r"env\.mixture 'gait' matches no"),
    ],
)
def test_what_leads_nowhere_is_told_before_anything_begins(settings, message):
    walkers(-30.0, 30.0).save("set")
    walkers(0.0, inputs=3).save("other")
    Path("empty").mkdir()
    Path("sb.zip").write_text("nothing")
    settings = {"behaviours": ["ways.py:leftwards"], **settings}
    with pytest.raises(ValueError, match=message):
        build_world(replace(LINE, **settings))


def test_a_wrong_action_is_told_with_its_place():
    world = build_world(replace(LINE, behaviours=["ways.py:wrong"]))
    with pytest.raises(ValueError, match=r"behaviour 'wrong' must return actions in 0\.\.1.*ways"):
        right_share(world, "wrong")
