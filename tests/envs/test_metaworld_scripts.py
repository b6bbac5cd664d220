"""Metaworld's scripted policies: their speed, their noise, and whether they do the task."""

from itertools import pairwise

import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.rollouts import lockstep
from popl_rl.envs._metaworld_data import check_scripted
from popl_rl.envs._metaworld_scripts import Scripted
from popl_rl.envs.metaworld_tasks import MetaworldTask, metaworld


def test_a_script_keeps_to_its_speed():
    env = metaworld()
    step = TensorDict({"observation": torch.from_numpy(env.reset(seed=0)[0])[None]}, [1])
    generator = torch.Generator().manual_seed(0)
    quick, slow = Scripted("drawer-open"), Scripted("drawer-open", speed=0.2)
    assert slow(step, generator)[0, :3].abs().max() == 0.25  # 0.2 of 0.8 m/s
    assert torch.equal(
        slow(step, generator)[:, :3], quick(step, generator)[:, :3].clamp(-0.25, 0.25)
    )
    noisy = Scripted("drawer-open", speed=0.2, noise=0.1)
    drawn = torch.cat([noisy(step, generator)[:, :3] for _ in range(200)])
    assert drawn.std(0).mean() == pytest.approx(0.025, rel=0.2)


def test_pushes_last_ten_steps():
    env = metaworld()
    step = TensorDict({"observation": torch.from_numpy(env.reset(seed=0)[0])[None]}, [1])
    pushed = Scripted("drawer-open", push=1.0)
    generator = torch.Generator().manual_seed(0)
    moves = [pushed(step, generator)[0, :3] for _ in range(40)]
    changes = [i for i, (a, b) in enumerate(pairwise(moves), 1) if not torch.equal(a, b)]
    assert changes == [10, 11, 21, 22, 32, 33]  # the script has a step between two pushes
    assert torch.equal(pushed(step, generator)[0, :3], moves[-1])
    pushed.reset()
    assert not torch.equal(pushed(step, generator)[0, :3], moves[-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"speed": 0}, "speed"), ({"noise": -1}, "noise"), ({"push": 2}, "push")],
)
def test_scripts_check_their_arguments(arguments, message):
    with pytest.raises(ValueError, match=f"{message} must be"):
        Scripted("drawer-open", **arguments)


def test_the_door_opens_at_half_speed():
    """Metaworld's own script does not."""
    slow, generator = Scripted("door-open", speed=0.4), torch.Generator()
    act = lambda step: slow(step, generator)  # noqa: E731
    episodes = lockstep([metaworld("door-open")], act, seeds=[0], max_steps=250)
    assert episodes["info", "success"].any()
    assert episodes["info", "hand_speed"].max() < 0.8


@pytest.mark.parametrize("task", ["sweep-into", "peg-insert-side"])
@pytest.mark.parametrize("speed", [0.25, 0.8])
def test_what_is_held_gets_there_at_any_speed(task, speed):
    """Metaworld's own scripts close the gripper too early for the lower one."""
    held, generator = Scripted(task, speed=speed), torch.Generator()
    act = lambda step: held(step, generator)  # noqa: E731
    episodes = lockstep([metaworld(task) for _ in range(2)], act, seeds=[0, 1], max_steps=320)
    assert episodes["info", "success"].any(1).all()


def test_rates_of_scripts(monkeypatch):
    quick = {"scripted/0.8": Scripted("plate-slide")}
    monkeypatch.setattr(MetaworldTask, "behaviours", lambda _: quick)
    assert check_scripted(MetaworldTask("plate-slide"), episodes=2) == {"scripted/0.8": 1.0}


def test_a_task_that_scripts_fail_is_refused():
    message = r"'drawer-open-v3'.*within 5 steps \(scripted/0.25 0%.*of 1 episodes, at least 50%"
    with pytest.raises(ValueError, match=message):
        check_scripted(MetaworldTask(max_steps=5), episodes=1)
