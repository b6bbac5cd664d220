"""HalfCheetah: who wants what, in the simulator's own numbers."""

import torch
from tensordict import TensorDict

from popl_rl.config import plain
from popl_rl.envs.half_cheetah import fast, saving
from popl_rl.evaluation.acting import Rolling
from popl_rl.experiments.data import build_groups, build_world


def test_utilities_by_speed_and_effort():
    speed = torch.tensor([[-1.0, 0.0, 2.0, 2.0]])
    cost = torch.tensor([[0.0, -0.1, -0.1, -0.4]])  # of no, one, one and four squared torques
    info = TensorDict({"x_velocity": speed, "reward_ctrl": cost}, [1, 4])
    steps = TensorDict({"info": info}, [1, 4])
    assert fast(steps).tolist() == [[-1, 0, 2, 2]]
    torch.testing.assert_close(saving(steps), torch.tensor([[-1.0, -2.0, 0.0, -6.0]]))


def test_raters_read_what_the_simulator_says(config_of):
    """What is wanted fast is Gymnasium's own reward, but for the cost of effort."""
    config = plain(config_of("env=half_cheetah"))
    world = build_world(config.env)
    wants_fast, wants_saving = build_groups(config.raters, world)
    assert list(world.behaviours) == [
        f"ppo:{wish}~{noise}" for wish in ("fast", "saving") for noise in (0.1, 0.3)
    ]
    (episodes,) = Rolling(world, episodes=3, max_steps=50, seed=0)(None)
    assert episodes["mask"].all()  # nobody falls
    reward, cost = episodes["reward"].float(), episodes["info"]["reward_ctrl"].float()
    torch.testing.assert_close(wants_fast.step_utility(episodes), reward - cost)
    effort = episodes["action"].clamp(-1, 1).square().sum(-1)
    difference = wants_fast.step_utility(episodes) - wants_saving.step_utility(episodes)
    torch.testing.assert_close(difference, 2 * effort, atol=1e-4, rtol=1e-4)
    assert wants_fast.label == wants_saving.label == "return"
