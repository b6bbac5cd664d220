"""Hopper: who wants what, in the simulator's own numbers."""

import torch
from tensordict import TensorDict

from popl_rl.config import plain
from popl_rl.envs.hopper import fast, upright
from popl_rl.evaluation.acting import Rolling
from popl_rl.experiments.data import build_groups, build_world


def test_utilities_by_speed_while_on_its_foot():
    speed = torch.tensor([[-1.0, 0.0, 2.0, 2.0]])
    healthy = torch.tensor([[1.0, 1.0, 1.0, 0.0]])
    info = TensorDict({"x_velocity": speed, "reward_survive": healthy}, [1, 4])
    steps = TensorDict({"info": info}, [1, 4])
    assert fast(steps).tolist() == [[0, 1, 3, 2]]
    assert upright(steps).tolist() == [[0, 1, -1, -2]]


def test_raters_read_what_the_simulator_says(config_of):
    """Whoever wants it fast wants Gymnasium's own reward, but for the cost of effort."""
    config = plain(config_of("env=hopper"))
    world = build_world(config.env)
    wants_fast, wants_upright = build_groups(config.raters, world)
    assert list(world.behaviours) == [
        f"ppo:{wish}~{noise}" for wish in ("fast", "upright") for noise in (0.1, 0.3)
    ]
    (episodes,) = Rolling(world, episodes=5, max_steps=200, seed=0)(None)
    steps = episodes[episodes["mask"]].unsqueeze(0)
    assert len(steps[0]) < 5 * 200  # random actions fall
    info = steps["info"]
    torch.testing.assert_close(
        wants_fast.step_utility(steps), (steps["reward"] - info["reward_ctrl"]).float()
    )
    on_foot = wants_upright.step_utility(steps) + info["x_velocity"].float().abs()
    assert on_foot.mean() > 0.9  # one at each step but the fall's
    assert wants_fast.label == wants_upright.label == "return"
