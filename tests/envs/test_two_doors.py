import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

from popl_rl.data.rollouts import lockstep
from popl_rl.data.tables import policy_return
from popl_rl.envs import two_doors as module
from popl_rl.envs.two_doors import Explorer, TwoDoors, two_doors
from popl_rl.raters.groups import make_groups

RIGHT, DOWN, LEFT, UP = range(4)
TURN_LEFT, TURN_RIGHT, FORWARD = range(3)
VARIANTS = [
    {},
    {"doors": 3},
    {"doors": 4, "start": "anywhere"},
    {"size": 7, "doors": 3},
    {"size": 8},
    {"size": 12, "doors": 4},
]


def place(env, x, y, direction):
    env.agent_pos, env.agent_dir, env.step_count = (x, y), direction, 0


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_the_table_is_the_environment(variant):
    """Every action from every state, and a random walk without interference."""
    env = two_doors(**variant)
    table = env.transition_table()
    env.reset(seed=0)
    for index, state in enumerate(env.states):
        for action in range(3):
            place(env, *state)
            step = table.steps[index, action]
            assert np.array_equal(env.gen_obs(), step["observation"].numpy())
            observation, reward, terminated, truncated, info = env.step(action)
            after = table.next_state[index, action]
            assert np.array_equal(observation, table.steps["observation"][after, 0].numpy())
            assert reward == pytest.approx(step["reward"].item())
            assert terminated == bool(table.terminal[index, action])
            assert not truncated
            assert info == {key: value.item() for key, value in step["info"].items()}
            assert info["next_state"] == after
    for seed in range(5):
        walk_agrees(env, table, seed)


def walk_agrees(env, table, seed):
    _, info = env.reset(seed=seed)
    state = info["state"]
    assert table.start[state] > 0
    env.action_space.seed(seed)
    over = False
    while not over:
        action = env.action_space.sample()
        _, _, terminated, truncated, info = env.step(action)
        assert info["state"] == state
        state = table.next_state[state, action]
        assert info["next_state"] == state
        over = terminated or truncated


@pytest.mark.parametrize(
    ("size", "doors", "rows"),
    [
        (9, 2, [2, 6]),
        (9, 3, [2, 6, 4]),
        (9, 4, [1, 7, 3, 5]),
        (7, 2, [2, 4]),
        (8, 2, [2, 5]),
    ],
)
def test_doors_by_hand(size, doors, rows):
    assert two_doors(size=size, doors=doors).door_cells == [(size // 2, row) for row in rows]


@pytest.mark.parametrize("size", [9, 11, 13, 15])
@pytest.mark.parametrize("doors", [2, 3, 4])
def test_odd_sizes_are_symmetric(size, doors):
    rows = sorted(row for _, row in two_doors(size=size, doors=doors).door_cells)
    assert rows == sorted(size - 1 - row for row in rows)


def test_a_walk_through_the_upper_door_by_hand():
    env = two_doors()
    env.reset(seed=0)
    place(env, 3, 2, RIGHT)
    outcomes = [env.step(action) for action in [FORWARD] * 4 + [TURN_RIGHT] + [FORWARD] * 2]
    assert [outcome[4]["door"] for outcome in outcomes] == [0, -1, -1, -1, -1, -1, -1]
    assert [outcome[1] for outcome in outcomes] == pytest.approx([-0.02] * 6 + [1.0])
    assert [outcome[4]["goal"] for outcome in outcomes] == [0] * 6 + [1]
    assert outcomes[-1][2] is True
    assert env.agent_pos == (7, 4) == env.goal_cell


def test_walking_back_through_a_door_does_not_count():
    env = two_doors()
    env.reset(seed=0)
    place(env, 5, 6, LEFT)
    assert [env.step(FORWARD)[4]["door"] for _ in range(2)] == [-1, -1]
    place(env, 3, 6, RIGHT)
    assert env.step(FORWARD)[4]["door"] == 1


def test_walls_stop():
    env = two_doors()
    env.reset(seed=0)
    place(env, 3, 4, RIGHT)
    assert env.step(FORWARD)[4]["next_state"] == env.state_index(3, 4, RIGHT)
    place(env, 1, 1, UP)
    assert env.step(FORWARD)[4]["next_state"] == env.state_index(1, 1, UP)


def test_observation_by_hand():
    env = two_doors()
    env.reset(seed=0)
    place(env, 2, 5, UP)
    observation = env.gen_obs()
    assert observation.dtype == np.float32
    assert np.flatnonzero(observation).tolist() == [1, 7 + 4, 14 + 3]
    assert env.observation_space.contains(observation)


def test_every_start_is_equally_likely():
    env = two_doors(size=7)
    table = env.transition_table()
    assert sorted(env.near_cells) == [(x, y) for x in (1, 2) for y in range(1, 6)]
    env.reset(seed=0)
    counts = torch.zeros(len(env.states))
    for _ in range(4000):
        counts[env.reset()[1]["state"]] += 1
    assert set(counts.nonzero().flatten().tolist()) == set(table.start.nonzero().flatten().tolist())
    # 40 states, 100 each on average; 60 is four standard deviations below.
    assert counts[counts > 0].min() > 60


def test_anywhere_is_everywhere_but_the_goal():
    env = two_doors(start="anywhere")
    start = env.transition_table().start
    never = {env.cell_of(state) for state in (start == 0).nonzero().flatten().tolist()}
    assert never == {env.goal_cell}
    assert (start > 0).sum() == len(env.states) - 4


def test_episodes_are_cut_off():
    env = two_doors(max_steps=3)
    env.reset(seed=0)
    assert [env.step(TURN_LEFT)[3] for _ in range(3)] == [False, False, True]


def test_a_seed_repeats_episodes():
    first, second = two_doors(), two_doors()
    runs = []
    for env in (first, second):
        runs.append([env.reset(seed=7)[1]["state"]] + [env.reset()[1]["state"] for _ in range(20)])
    assert runs[0] == runs[1]
    assert len(set(runs[0])) > 5


def test_gymnasium_knows_it():
    env = gymnasium.make("popl_rl/TwoDoors-v0", doors=3, max_steps=7)
    assert env.unwrapped.max_steps == 7
    assert len(env.unwrapped.door_cells) == 3
    assert env.spec.entry_point == "popl_rl.envs.two_doors:TwoDoors"
    check_env(two_doors(), skip_render_check=True)


def test_it_pickles():
    env = pickle.loads(pickle.dumps(two_doors(doors=4)))
    assert env.door_cells == two_doors(doors=4).door_cells


def test_doors_can_be_told_apart_in_a_render():
    env = two_doors(doors=4, render_mode="rgb_array")
    env.reset(seed=0)
    place(env, 1, 4, RIGHT)
    picture = env.render()
    tile = picture.shape[0] // 9
    centres = [(*cell, tile) for cell in (*env.door_cells, env.goal_cell, (4, 4), (6, 1))]
    colours = {tuple(picture[y * t + t // 2, x * t + t // 2]) for x, y, t in centres}
    assert len(colours) == len(centres)


def test_cells_and_indices_agree():
    env = two_doors()
    for index, (x, y, direction) in enumerate(env.states):
        assert env.state_index(x, y, direction) == index
        assert env.cell_of(index) == (x, y) == tuple(env.cells[index].tolist())


def best_policy(group):
    return torch.nn.functional.one_hot(group.advantages.argmax(1), 3).double()


def through(env, door):
    """Return the table and a utility whose return is the share of episodes through a door."""
    table = env.transition_table()
    return table, (table.steps["info", "door"] == door).double()


@pytest.mark.parametrize("doors", [2, 3, 4])
def test_each_group_wants_its_own_door(doors):
    env = two_doors(doors=doors)
    names = ["upper", "lower", "third", "fourth"][:doors]
    groups = make_groups(names, table=env.transition_table())
    for own, group in enumerate(groups):
        for door in range(doors):
            table, passed = through(env, door)
            share = policy_return(table, best_policy(group), passed, horizon=60)
            assert share == pytest.approx(1.0 if door == own else 0.0, abs=1e-6)


def test_utility_by_hand():
    env = two_doors()
    table = env.transition_table()
    at_door = env.state_index(3, 2, RIGHT)
    at_goal = env.state_index(6, 4, RIGHT)
    for function, door in [(module.upper, -0.02), (module.lower, -2.02), (module.third, -2.02)]:
        utility = function(table.steps)
        assert utility.shape == (len(env.states), 3)
        assert utility[at_door].tolist() == pytest.approx([-0.02, -0.02, door])
        assert utility[at_goal].tolist() == pytest.approx([-0.02, -0.02, 0.98])


def test_the_mirror_image_of_upper_is_lower():
    env = two_doors()
    upper, lower = make_groups(["upper", "lower"], table=env.transition_table())
    turned = {RIGHT: RIGHT, DOWN: UP, LEFT: LEFT, UP: DOWN}
    mirror = [env.state_index(x, 8 - y, turned[d]) for x, y, d in env.states]
    torch.testing.assert_close(upper.advantages, lower.advantages[mirror][:, [1, 0, 2]])


def test_behaviours_are_policies_that_use_their_doors():
    env = two_doors(doors=3)
    behaviours = env.behaviours()
    names = [f"planner/upper/{temperature}" for temperature in (0.03, 0.1, 0.3)]
    assert list(behaviours)[:3] == names
    assert list(behaviours)[9:] == ["explorer", "random"]
    for probabilities in [v for name, v in behaviours.items() if name != "explorer"]:
        assert probabilities.shape == (len(env.states), 3)
        torch.testing.assert_close(probabilities.sum(1), torch.ones(len(env.states)))
    shares = []
    for name in ("planner/third/0.03", "planner/third/0.1", "random"):
        table, passed = through(env, 2)
        shares.append(policy_return(table, behaviours[name], passed, horizon=60))
    assert shares[0] > 0.95
    assert shares[0] > shares[1] > shares[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 5}, "size=5 is too small for 2 doors.*nearest size that fits is 7"),
        ({"size": 7, "doors": 4}, "too small for 4 doors.*fits is 9"),
        ({"size": -3}, "fits is 7"),
        ({"doors": 1}, "doors must be 2, 3 or 4, got 1"),
        ({"doors": 5}, "doors must be 2, 3 or 4, got 5"),
        ({"start": "far"}, "start must be 'near', 'anywhere' or 'mixed', got 'far'"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        TwoDoors(**arguments)


@pytest.mark.parametrize("action", [3, 6, -1])
def test_actions_of_minigrid_that_are_left_out(action):
    env = two_doors()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be 0 \(left\), 1 \(right\) or 2"):
        env.step(action)


def test_an_explorer_passes_every_door_and_never_means_to_end_the_episode():
    env = two_doors(start="anywhere")
    world = env.unwrapped
    explorer = Explorer(world.transition_table(), world.cells, slip=0.0)
    generator = torch.Generator().manual_seed(0)
    episodes = lockstep(
        [two_doors(start="anywhere", max_steps=200) for _ in range(8)],
        lambda step: explorer(step, generator),
        seeds=range(8),
        max_steps=200,
    )
    assert episodes["mask"].all()
    assert not episodes["info", "goal"].any()
    assert {0, 1} <= set(episodes["info", "door"].unique().tolist())


def test_a_reset_explorer_takes_any_number_of_walkers():
    world = two_doors().unwrapped
    explorer = Explorer(world.transition_table(), world.cells)
    generator = torch.Generator().manual_seed(0)
    for count in (3, 5):
        explorer.reset()
        step = TensorDict({"info": {"next_state": torch.zeros(count).long()}}, [count])
        action = explorer(step, generator)
        assert action.shape == (count,)
        assert set(action.tolist()) <= {0, 1, 2}


def test_mixed_starts_are_half_near_and_half_anywhere():
    world = two_doors(start="mixed").unwrapped
    start = world.transition_table().start
    near = torch.tensor([tuple(cell) in set(world.near_cells) for cell in world.cells.tolist()])
    free = len(world.states) - 4  # the goal's four directions are no starts
    expected = 0.5 + 0.5 * len(world.near_cells) * 4 / free
    assert start[near].sum().item() == pytest.approx(expected, abs=1e-5)
    assert start.sum().item() == pytest.approx(1.0, abs=1e-5)
