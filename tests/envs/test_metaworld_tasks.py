"""Metaworld's tasks as environments, their raters, pictures and configurations."""

import re

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl.envs._metaworld_scripts import Scripted
from popl_rl.envs._metaworld_simulator import task_name
from popl_rl.envs.metaworld_tasks import (
    STEP_SECONDS,
    MetaworldTask,
    brisk_but_careful,
    fast,
    gentle,
    metaworld,
)
from popl_rl.plotting.animation import record_gif

TASKS = ["drawer-open", "door-open", "button-press", "plate-slide", "sweep-into", "bin-picking"]


def draw_actions(count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 4)).astype(np.float32)


def play(env, actions):
    return [env.step(action) for action in actions]


def same(one, other):
    return all(
        np.array_equal(a[0], b[0]) and a[1:] == b[1:] for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("given", ["drawer-open", "drawer_open", "drawer-open-v3", "Drawer_Open"])
def test_names_of_tasks(given):
    assert task_name(given) == "drawer-open-v3"


def test_an_unknown_task_is_told_its_nearest():
    with pytest.raises(ValueError, match="'drawr-open'; did you mean 'drawer-open'"):
        metaworld("drawr-open")
    with pytest.raises(ValueError, match="one of Metaworld's 50 v3 tasks"):
        metaworld("xyzzy")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"max_steps": 0}, "max_steps must be at least 1"), ({"render_mode": "ansi"}, "render_mode")],
)
def test_arguments_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        metaworld(**arguments)


@pytest.mark.parametrize("task", ["drawer-open", "button-press", "sweep-into"])
def test_seeds_make_episodes(task):
    """Whatever came before, and whoever else uses the simulator meanwhile."""
    env, other = metaworld(task), metaworld(task)
    first, info = env.reset(seed=1)
    steps = play(env, draw_actions(10))
    other.reset(seed=2)
    again, repeated = other.reset(seed=1)
    assert np.array_equal(first, again)
    assert info == repeated
    mixed = []
    env.reset(seed=3)
    for action in draw_actions(10):
        mixed.append(other.step(action))
        env.step(-action)
    assert same(steps, mixed)
    assert not np.array_equal(env.reset(seed=2)[0], first)
    assert not np.array_equal(env.reset()[0], env.reset()[0])


@pytest.mark.parametrize("task", ["drawer-open", "door-lock", "assembly", "basketball"])
def test_taking_turns_changes_no_bit(task):
    """Tasks move bodies of the model, which all share, and keep views of MuJoCo's memory."""
    envs, alone = [metaworld(task) for _ in range(3)], metaworld(task)
    begins = [env.reset(seed=seed)[0] for seed, env in enumerate(envs)]
    in_turn = [[env.step(action) for env in envs] for action in draw_actions(12)]
    for seed, steps in enumerate(zip(*in_turn, strict=True)):
        assert np.array_equal(alone.reset(seed=seed)[0], begins[seed])
        assert same(play(alone, draw_actions(12)), steps)
    never_reset = metaworld(task)
    never_reset.set_state(envs[1].get_state())
    assert same(play(never_reset, draw_actions(5, seed=1)), play(envs[1], draw_actions(5, seed=1)))


@pytest.mark.parametrize("task", TASKS)
def test_observations_are_put_together_as_metaworld_does(task):
    env = metaworld(task)
    env.reset(seed=0)
    for action in draw_actions(5):
        env.step(action)
        own = env.unwrapped.simulator.env
        assert np.array_equal(
            own._get_curr_obs_combined_no_goal(),
            super(type(own), own)._get_curr_obs_combined_no_goal(),
        )


@pytest.mark.parametrize("task", ["door-open", "bin-picking"])
def test_a_restored_state_goes_on_to_the_bit(task):
    env = metaworld(task)
    observation, _ = env.reset(seed=0)
    quick, generator = Scripted(task), torch.Generator()
    for _ in range(80):  # by then the hand touches something
        observation = env.step(quick.act(observation[None], generator)[0].numpy())[0]
    state = env.get_state()
    actions = draw_actions(20)
    expected = play(env, actions)
    assert max(step[4]["contact_force"] for step in expected) > 0
    seen, info = env.set_state(state)
    assert np.array_equal(seen, observation)
    assert info["time"] == 80
    assert same(play(env, actions), expected)
    other = metaworld(task)
    other.reset(seed=1)
    other.set_state(state)
    assert same(play(other, actions), expected)


def test_the_first_observation_shows_where_things_are():
    env = metaworld(max_steps=1000)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        later = play(env, np.zeros((5, 4), dtype=np.float32))[-1][0]
        assert np.allclose(observation[4:7], later[4:7], atol=1e-3)
        assert np.array_equal(observation[:18], observation[18:36])
        assert observation[36:].any()


def test_speeds_are_displacements_over_time():
    env = metaworld()
    observation, info = env.reset(seed=0)
    assert (info["hand_speed"], info["hand_acceleration"], info["time"]) == (0, 0, 0)
    hands = [observation[:3]]
    steps = play(env, draw_actions(5))
    hands += [step[0][:3] for step in steps]
    velocity = np.diff(np.stack(hands), axis=0) / 0.0125
    speed = [step[4]["hand_speed"] for step in steps]
    assert np.allclose(speed, np.linalg.norm(velocity, axis=1), atol=1e-4)
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / 0.0125
    assert np.allclose([s[4]["hand_acceleration"] for s in steps[1:]], change, atol=1e-2)
    remaining = [info["remaining"], *(step[4]["remaining"] for step in steps)]
    closed = [step[4]["closed"] for step in steps]
    assert np.allclose(closed, -np.diff(remaining), atol=1e-6)
    simulated = env.unwrapped.simulator.env
    assert simulated.model.opt.timestep * simulated.frame_skip == pytest.approx(STEP_SECONDS)


def test_episodes_end_when_done_or_out_of_time():
    def ends(env, steps):
        observation, _ = env.reset(seed=0)
        act, generator = Scripted("button-press"), torch.Generator()
        for _ in range(steps):
            action = act.act(observation[None], generator)[0].numpy()
            observation, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                break
        return terminated, truncated, int(info["success"]), int(info["time"])

    assert ends(metaworld("button-press"), 100) == (True, False, 1, 58)
    # Once done, always done, and the episode may go on.
    assert ends(metaworld("button-press", terminate=False), 70) == (False, False, 1, 70)
    assert ends(metaworld("button-press", max_steps=20), 100) == (False, True, 0, 20)


def test_steps_go_on_beyond_metaworlds_horizon():
    env = metaworld(max_steps=1000)
    env.reset(seed=0)
    env.unwrapped.simulator.env.curr_path_length = 499
    assert [step[3] for step in play(env, draw_actions(3))] == [False] * 3


def test_mistakes_of_use_are_told():
    env = metaworld()
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(np.zeros(4, np.float32))
    with pytest.raises(RuntimeError, match="call reset"):
        env.unwrapped.get_state()
    with pytest.raises(RuntimeError, match="call reset"):
        metaworld(render_mode="rgb_array").render()
    env.reset(seed=0)
    for wrong in (np.zeros(3, np.float32), np.full(4, np.nan, np.float32)):
        with pytest.raises(ValueError, match="4 finite numbers"):
            env.step(wrong)


def made_up(**info):
    columns = {name: torch.tensor([value]) for name, value in info.items()}
    length = len(next(iter(info.values())))
    return TensorDict({"info": TensorDict(columns, [1, length])}, [1, length])


def test_utilities_by_hand():
    """In seconds: a step waits 0.0125; 0.01 m closed is worth 0.01 at 1 m/s, 0.05 at 0.2 m/s."""
    segments = made_up(
        success=[0, 0, 1, 1, 1],
        closed=[0.01, 0.0, 0.0, 0.0, 0.0],
        hand_speed=[0.2, 0.8, 0.0, 0.0, 0.1],
        hand_acceleration=[0.0, 0.0, 0.0, 5.0, 0.0],
        contact_force=[0.0, 0.0, 100.0, 0.0, 200.0],
    )
    assert fast(segments)[0].tolist() == pytest.approx([-0.0025, -0.0125, 0, 0, 0])
    assert gentle(segments)[0].tolist() == pytest.approx(
        [0.05 - 0.0125, -0.0125 - 9 * 0.0125, 0, -0.0125, -0.00125]
    )
    assert brisk_but_careful(segments)[0].tolist() == pytest.approx(
        [0.025 - 0.0125, -0.0125 - 0.0125, 0, -0.0125 / 4, -0.00125]
    )


def test_a_missing_renderer_gets_a_hint(monkeypatch):
    def fail(*arguments):
        raise AttributeError("eglQueryString")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    monkeypatch.setattr("sys.platform", "linux")
    env = MetaworldTask(render_mode="rgb_array")
    env.reset(seed=0)
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError, match=r"there is no screen.*MUJOCO_GL to egl"):
        env.render()
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(RuntimeError, match=r"eglQueryString.*libegl1"):
        env.render()


def test_a_gif_has_the_episode(monkeypatch, tmp_path):
    picture = np.zeros((8, 8, 3), np.uint8)
    shades = iter(range(255))
    monkeypatch.setattr(MetaworldTask, "render", lambda _: picture + np.uint8(next(shades)))
    env = MetaworldTask("button-press", max_steps=10, render_mode="rgb_array")
    path = tmp_path / "new" / "episode.gif"
    script, generator = Scripted("button-press"), torch.Generator()
    # 80 steps a second, of which every fourth is shown: the start, after 4, 8, and the end.
    assert record_gif(env, lambda seen: script.act(seen.numpy(), generator), path) == 4
    assert re.match(rb"GIF8", path.read_bytes())


def test_an_environment_that_does_not_render_is_refused(tmp_path):
    with pytest.raises(ValueError, match="render_mode='rgb_array', got None"):
        record_gif(MetaworldTask(), lambda _: torch.zeros(1, 4), tmp_path / "a.gif")


@pytest.mark.parametrize("task", [*TASKS, "any"])
def test_configurations(task, config_of):
    config = config_of(f"env=metaworld/{task.replace('-', '_')}", "env.max_steps=50")
    assert (config.raters.groups, config.raters.label) == (["fast", "gentle"], "regret")
    options = dict(config.env.options)
    assert options == {"task": TASKS[0] if task == "any" else task, "max_steps": 50}


def test_a_configuration_of_any_task(config_of):
    config = config_of(
        "env=metaworld/any", "env.options.task=window-close", "raters=fast_gentle_brisk"
    )
    assert config.env.options.task == "window-close"
    assert len(config.raters.groups) == 3
