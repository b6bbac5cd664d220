"""Minigrid's worlds: what is listed is what the simulator does, and groups differ in them."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from minigrid.envs.doorkey import DoorKeyEnv

from popl_rl.data.environments import make_world
from popl_rl.data.rollouts import lockstep
from popl_rl.data.tables import policy_return, solve
from popl_rl.envs.door_key import door_key, quick, thorough
from popl_rl.envs.dynamic_obstacles import DynamicObstacles, timid
from popl_rl.envs.lava_gap import LavaGap, bold, cautious, lava_gap
from popl_rl.envs.listed_minigrid import ListedMinigrid, MinigridListing
from popl_rl.testing import check_env as check_ours

WORLDS = ["lava_gap", "door_key", "dynamic_obstacles"]


@pytest.mark.parametrize("view", ["full", "partial"])
@pytest.mark.parametrize("name", WORLDS)
def test_they_are_environments(name, view):
    env = make_world(name, options={"view": view}).env.unwrapped
    check_env(env, skip_render_check=True)
    check_ours(name, view=view)


def test_the_list_says_what_the_simulator_does():
    """Random episodes of Minigrid's own locked door, step by step beside the list."""
    listed = door_key(size=5, layouts=2, view="partial")
    assert isinstance(listed, ListedMinigrid)
    table = listed.transition_table()
    own = DoorKeyEnv(size=5)
    random = np.random.default_rng(0)
    reached = 0
    for seed in (0, 1) * 10:
        seen, _ = own.reset(seed=seed)
        state = seed  # first states come first, in the order of the layouts
        for _ in range(100):
            assert np.array_equal(
                table.steps["observation"][state, 0], seen["image"].ravel().astype(np.float32)
            )
            action = int(random.integers(5))
            seen, reward, ended, _, _ = own.step((0, 1, 2, 3, 5)[action])
            assert bool(table.terminal[state, action]) == ended
            assert float(table.steps["reward"][state, action]) == (reward > 0)
            door = next(thing for thing in own.grid.grid if thing and thing.type == "door")
            assert int(table.steps["info", "door_open"][state, action]) == door.is_open
            state = int(table.next_state[state, action])
            if ended:
                reached += 1
                break
    assert reached > 0


@pytest.mark.parametrize(
    ("make", "groups"), [(lava_gap, (bold, cautious)), (door_key, (quick, thorough))]
)
def test_what_is_best_for_one_group_is_not_for_the_other(make, groups):
    table = make().transition_table()
    utilities = [group(table.steps) for group in groups]
    choices = table.next_state.shape[1]
    best = [
        torch.nn.functional.one_hot(solve(table, utility)[0].argmax(1), choices).float()
        for utility in utilities
    ]
    returns = torch.tensor(
        [[policy_return(table, b, u, horizon=60) for b in best] for u in utilities]
    )
    assert (returns.diagonal() > 0.25).all()
    assert (returns.diagonal() > returns.flip(1).diagonal() + 0.9).all()


def test_the_bold_go_through_the_gap_and_the_cautious_around():
    env = lava_gap()
    table = env.transition_table()
    for group, near in ((bold, True), (cautious, False)):
        best = solve(table, group(table.steps))[0].argmax(1)
        state, beside = int(table.start.argmax()), False
        for _ in range(40):
            beside |= bool(table.steps["info", "near"][state, best[state]])
            state = int(table.next_state[state, best[state]])
        assert table.terminal[state].all()
        assert beside == near


def test_walkers_among_moving_obstacles_show_both_ways():
    world = make_world("dynamic_obstacles")
    generator = torch.Generator().manual_seed(0)
    envs = [world.make() for _ in range(40)]
    returns = {}
    for name in ("walker/bold", "walker/timid", "random"):
        act = world.behaviours[name]
        episodes = lockstep(envs, lambda s: act(s, generator), seeds=range(40), max_steps=60)  # noqa: B023
        mask = episodes["mask"].float()
        assert name == "random" or int(episodes["info", "accident"].sum()) == 0
        returns[name] = [float((g(episodes) * mask).sum(1).mean()) for g in (bold, timid)]
    assert returns["walker/bold"][0] > returns["walker/timid"][0] + 0.5
    assert returns["walker/timid"][1] > returns["walker/bold"][1] + 0.5
    assert returns["random"][1] < -2


def test_obstacles_are_seen_as_the_agent_looks():
    env = DynamicObstacles(obstacles=1)
    env.reset(seed=0)
    env.agent_pos, env.obstacles[0].cur_pos = (3, 3), np.array((4, 3))  # to its right
    for direction, place in ((0, (1, 2)), (1, (2, 1)), (2, (3, 2)), (3, (2, 3))):
        env.agent_dir = direction
        around = env.gen_obs()[-25:].reshape(5, 5)
        assert tuple(np.argwhere(around)[0]) == place


def test_layouts_are_listed_once_and_can_begin_anywhere():
    one, two = lava_gap(), lava_gap(start="anywhere")
    assert one.transition_table().next_state is two.transition_table().next_state
    assert int((two.transition_table().start > 0).sum()) > int(
        (one.transition_table().start > 0).sum()
    )


def test_pictures_of_segments_show_where_the_agent_was():
    env = lava_gap(render_mode="rgb_array")
    env.reset(seed=0)
    steps = env.transition_table().steps
    frames = env.render_segment(steps[:1, 2])
    assert len(frames) == 2
    assert frames[0].shape == (9 * 24, 9 * 24, 3)
    assert env.render().shape[-1] == 3


def test_the_readme_lists_another_world_of_minigrid(tmp_path):
    """The code block of envs/README.md, on fewer layouts."""
    text = (Path(__file__).parents[2] / "envs" / "README.md").read_text()
    code = text.split("```python\nfrom functools import cache")[1].split("```")[0]
    file = tmp_path / "rooms.py"
    file.write_text("from functools import cache" + code.replace("range(2)", "range(1)"))
    world = make_world(f"{file}:rooms")
    assert len(world.table.start) > 500
    assert "planner/upward/0.1" in world.behaviours
    assert (world.table.steps["info", "row"] > 0).any()


def test_gymnasium_knows_them():
    for name in ("LavaGap", "DoorKey", "DynamicObstacles"):
        made = gymnasium.make(f"popl_rl/{name}-v0")
        observation, _ = made.reset(seed=0)
        assert made.observation_space.contains(observation)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LavaGap(size=8), "odd and at least 9"),
        (lambda: door_key(size=4), "size must be at least 5"),
        (lambda: door_key(layouts=0), "layouts must be at least 1"),
        (lambda: lava_gap(view="all"), "view must be"),
        (lambda: lava_gap(start="here"), "start must be"),
        (lambda: lava_gap(max_steps=0), "max_steps must be at least 1"),
        (lambda: lava_gap(render_mode="human"), "render_mode must be"),
        (lambda: MinigridListing(LavaGap(), seeds=[]), "at least one layout"),
        (lambda: MinigridListing(LavaGap(), most=50), "more than 50 states"),
        (lambda: DynamicObstacles(obstacles=9), "obstacles must be from 1 to 5"),
        (lambda: DynamicObstacles(start="mixed"), "start must be"),
        (lambda: lava_gap().step(3), "action must be from 0 to 2"),
    ],
)
def test_what_they_refuse(make, message):
    with pytest.raises(ValueError, match=message):
        make()
