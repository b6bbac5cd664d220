"""Hopper and HalfCheetah: who wants what, in the simulator's own numbers."""

import pytest
import torch
from tensordict import TensorDict

from popl_rl.config import plain
from popl_rl.envs import half_cheetah, hopper
from popl_rl.evaluation.acting import Rolling
from popl_rl.experiments.data import build_groups, build_world

SPEED = [-1.0, 0.0, 2.0, 2.0]
COST = [0.0, -0.1, -0.1, -0.4]  # of no, one, one and four squared torques


@pytest.mark.parametrize(
    ("rater", "name", "numbers", "utility"),
    [
        (hopper.fast, "reward_survive", [1.0, 1.0, 1.0, 0.0], [0.0, 1.0, 3.0, 2.0]),
        (hopper.upright, "reward_survive", [1.0, 1.0, 1.0, 0.0], [0.0, 1.0, -1.0, -2.0]),
        (half_cheetah.fast, "reward_ctrl", COST, [-1.0, 0.0, 2.0, 2.0]),
        (half_cheetah.saving, "reward_ctrl", COST, [-1.0, -2.0, 0.0, -6.0]),
    ],
)
def test_utilities_by_speed_and_what_else_counts(rater, name, numbers, utility):
    """What else counts is in Hopper to be on its foot, in HalfCheetah the effort."""
    info = {"x_velocity": torch.tensor([SPEED]), name: torch.tensor([numbers])}
    steps = TensorDict({"info": TensorDict(info, [1, 4])}, [1, 4])
    assert rater(steps).tolist() == [utility]


@pytest.fixture
def random_run(config_of):
    """Raters of both groups of an environment, and episodes ``[E, T]`` of random actions there."""

    def run(env, wishes, *, episodes, max_steps):
        config = plain(config_of(f"env={env}"))
        world = build_world(config.env)
        shown = [f"ppo:{wish}~{noise}" for wish in wishes for noise in (0.1, 0.3)]
        assert list(world.behaviours) == shown
        one, other = build_groups(config.raters, world)
        assert one.label == other.label == "return"
        (found,) = Rolling(world, episodes=episodes, max_steps=max_steps, seed=0)(None)
        return one, other, found

    return run


def test_raters_of_hopper_read_what_the_simulator_says(random_run):
    """Whoever wants it fast wants Gymnasium's own reward, but for the cost of effort."""
    fast, upright, episodes = random_run("hopper", ("fast", "upright"), episodes=5, max_steps=200)
    steps = episodes[episodes["mask"]].unsqueeze(0)
    assert len(steps[0]) < 5 * 200  # random actions fall
    info = steps["info"]
    reward = (steps["reward"] - info["reward_ctrl"]).float()
    torch.testing.assert_close(fast.step_utility(steps), reward)
    on_foot = upright.step_utility(steps) + info["x_velocity"].float().abs()
    assert on_foot.mean() > 0.9  # one at each step but the fall's


def test_raters_of_half_cheetah_read_what_the_simulator_says(random_run):
    """What is wanted fast is Gymnasium's own reward, but for the cost of effort."""
    fast, saving, episodes = random_run(
        "half_cheetah", ("fast", "saving"), episodes=3, max_steps=50
    )
    assert episodes["mask"].all()  # nobody falls
    reward, cost = episodes["reward"].float(), episodes["info"]["reward_ctrl"].float()
    torch.testing.assert_close(fast.step_utility(episodes), reward - cost)
    effort = episodes["action"].clamp(-1, 1).square().sum(-1)
    difference = fast.step_utility(episodes) - saving.step_utility(episodes)
    torch.testing.assert_close(difference, 2 * effort, atol=1e-4, rtol=1e-4)
