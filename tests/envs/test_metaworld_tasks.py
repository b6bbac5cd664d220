import re
from itertools import pairwise

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.rollouts import lockstep
from popl_rl.data.segments import collect_segments
from popl_rl.envs import _metaworld_data as data
from popl_rl.envs._metaworld_data import check_scripted, collect_continuations
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
from popl_rl.models.policy_set import PolicySet
from popl_rl.plotting.animation import record_gif
from popl_rl.trainers.train_popl import run

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
    simulated = env.unwrapped._shared.env
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
    env.unwrapped._shared.env.curr_path_length = 499
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
    pushed.reset()
    assert len(pushed._left) == 0


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


def test_behaviours_give_segments():
    env = metaworld("plate-slide").unwrapped
    behaviours = env.behaviours()
    assert {name.split("/")[0] for name in behaviours} == {"scripted", "rough"}
    chosen = {name: behaviours[name] for name in ("scripted/0.25", "rough/0.8")}
    segments = collect_segments(
        lambda: metaworld("plate-slide"),
        chosen,
        num_segments=6,
        length=10,
        max_steps=20,
        num_envs=2,
        generator=torch.Generator().manual_seed(0),
    )
    assert segments.batch_size == (6, 10)
    assert segments["action"].abs().max() <= 1


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


def test_continuations_begin_alike():
    env = MetaworldTask("button-press")
    generator = torch.Generator().manual_seed(0)
    counts = []
    segments = collect_continuations(
        env, starts=3, per_start=2, length=12, generator=generator, progress=counts.append
    )
    assert segments.batch_size == (6, 12)
    assert segments["info", "start"][:, 0].tolist() == [0, 0, 1, 1, 2, 2]
    first = segments["observation"][:, 0]
    assert torch.equal(first[0::2], first[1::2])
    assert not torch.equal(first[0], first[2])
    assert not torch.equal(segments["action"][0], segments["action"][1])
    assert counts == [2, 4, 6]
    with pytest.raises(ValueError, match="per_start must be 1 to 4"):
        collect_continuations(env, starts=1, per_start=9, generator=generator)
    with pytest.raises(ValueError, match="length must be at least 1"):
        collect_continuations(env, starts=1, length=0, generator=generator)


def test_a_task_that_scripts_fail_is_refused():
    message = r"'drawer-open-v3'.*within 5 steps \(scripted/0.25 0%.*of 1 episodes, at least 50%"
    with pytest.raises(ValueError, match=message):
        check_scripted(MetaworldTask(max_steps=5), episodes=1)


def test_rates_of_scripts(monkeypatch):
    quick = {"scripted/0.8": Scripted("plate-slide")}
    monkeypatch.setattr(MetaworldTask, "behaviours", lambda _: quick)
    assert data.check_scripted(MetaworldTask("plate-slide"), episodes=2) == {"scripted/0.8": 1.0}


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
    speeds = options.pop("speeds", [0.25, 0.4, 0.6, 0.8])
    assert min(speeds) == (0.6 if task == "sweep-into" else 0.25)
    assert options == {"task": TASKS[0] if task == "any" else task, "max_steps": 50}


def test_a_configuration_of_any_task(config_of):
    config = config_of(
        "env=metaworld/any", "env.options.task=window-close", "raters=fast_gentle_brisk"
    )
    assert config.env.options.task == "window-close"
    assert len(config.raters.groups) == 3


def test_a_number_of_segments_that_is_no_multiple_of_the_speeds_is_refused():
    generator = torch.Generator().manual_seed(0)
    with pytest.raises(ValueError, match=r"multiple of the scripted speeds.*got 30 segments and 4"):
        MetaworldTask().collect_segments(30, 8, generator=generator)
    with pytest.raises(ValueError, match="got 4 segments and 1 speeds"):
        MetaworldTask(speeds=[0.5]).collect_segments(4, 8, generator=generator)


def test_a_run_from_segments_to_animations(config_of, tmp_path, monkeypatch):
    """One tiny run: style codes, one set of segments for two runs, motion and its pictures."""
    picture = np.zeros((8, 8, 3), np.uint8)
    monkeypatch.setattr(MetaworldTask, "render", lambda env: picture + np.uint8(env._time % 250))
    monkeypatch.setattr(data, "check_scripted", lambda *_, **__: {})
    overrides = (
        "env=metaworld/button_press",
        "env.max_steps=90",
        f"data.store={tmp_path / 'store'}",
        "data.segments=24",
        "data.length=20",
        "raters.count=8",
        "raters.answers=5",
        "method.hidden=[16,16]",
        "method.clone_steps=60",
        "method.members=4",
        "method.generations=2",
        "method.steps=2",
        "method.pooled_steps=3",
        "method.specialist_steps=2",
        "evaluation.episodes=2",
        "evaluation.new_raters=2",
        "evaluation.answers=5",
        "evaluation.baseline_steps=10",
        "logger=csv",
    )
    result = run(config_of(*overrides, f"run_dir={tmp_path / 'run'}"))
    table = result.board.results
    assert {"fast", "gentle"} <= set(table.group)
    assert {"popl", "pooled_cpl", "oracle", "clone", "random"} <= set(table.method)
    assert table[table.measure == "return"].value.notna().all()
    speeds = table[table.measure.isin(["mean_hand_speed", "peak_hand_speed"])]
    assert len(speeds) >= 20
    assert (speeds.value > 0).all()
    # A recovery of 0 is what the oracle of the other group is worth.
    for group in ("fast", "gentle"):
        value, best = (result.board.value(who, group, "return") for who in ("clone", "oracle"))
        recovered = result.board.value("clone", group, "recovery")
        assert np.isnan(recovered) or (recovered < 1) == (value < best)
    drawn = {path.name for path in (tmp_path / "run" / "figures").iterdir()}
    assert {"plane.png", "profiles.png", "fast.gif", "gentle.gif"} <= drawn
    loaded = PolicySet.load(tmp_path / "run" / "policies")
    seen = torch.rand(3, 39, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(loaded.act(seen), result.policies.act(seen), atol=1e-4)

    (store,) = (tmp_path / "store").glob("metaworld-button-press-*")
    kept = [path for path in store.rglob("*") if path.is_file() and path.suffix != ".lock"]
    before = {path: path.stat().st_mtime_ns for path in kept}
    again = run(config_of(*overrides, f"run_dir={tmp_path / 'again'}"))
    assert again.board.results.equals(table)
    assert {path: path.stat().st_mtime_ns for path in kept} == before
