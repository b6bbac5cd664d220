import pytest
import torch

from popl_rl.config import DataConfig, EnvConfig
from popl_rl.envs import two_doors_alike
from popl_rl.experiments.data import build_world, fresh_segments
from popl_rl.raters.groups import make_groups

ENV = EnvConfig(data_options={"start": "mixed"}, mixture={"planner/*": 0.5, "explorer": 0.5})


@pytest.fixture(scope="module")
def world():
    return build_world(ENV)


@pytest.fixture(scope="module")
def segments(world):
    return fresh_segments(DataConfig(segments=1000), world, seed=0, env=EnvConfig(max_steps=60))


def agreement(names, world, segments):
    """Share of random pairs that two groups order alike, by regret."""
    groups = make_groups(names, label="regret", table=world.table)
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    generator = torch.Generator().manual_seed(0)
    pair = torch.randint(len(segments), (20_000, 2), generator=generator)
    apart = segment_utility[:, pair[:, 0]] - segment_utility[:, pair[:, 1]]
    strict = (apart.abs() > 1e-6).all(0)
    return float(((apart[0] > 0) == (apart[1] > 0))[strict].float().mean())


@pytest.mark.parametrize("percent", two_doors_alike.FINES)
def test_groups_agree_on_as_much_as_their_names_say(percent, world, segments):
    names = [f"popl_rl.envs.two_doors_alike:{door}_{percent}" for door in ("upper", "lower")]
    assert agreement(names, world, segments) == pytest.approx(percent / 100, abs=0.02)


def test_the_groups_that_they_are_made_after_agree_on_less(world, segments):
    assert agreement(["upper", "lower"], world, segments) == pytest.approx(0.38, abs=0.02)


def test_utility_by_hand(world):
    """By the other door: a step and the fine."""
    steps = world.table.steps
    door, goal = steps["info", "door"], steps["info", "goal"]
    utility = two_doors_alike.upper_70(steps)
    assert utility[door == 1].unique().tolist() == pytest.approx([-0.34])
    assert utility[door == 0].unique().tolist() == pytest.approx([-0.02])
    assert utility[goal == 1].unique().tolist() == pytest.approx([0.98])
    assert two_doors_alike.lower_70(steps)[door == 0].unique().tolist() == pytest.approx([-0.34])
