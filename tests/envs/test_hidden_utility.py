import pickle
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest
from tensordict import TensorDict

from popl_rl import registry
from popl_rl.data.behaviours import random_behaviour
from popl_rl.data.rollouts import lockstep
from popl_rl.data.segments import collect_segments
from popl_rl.envs.hidden_utility import HiddenUtility, blend, hidden_utility, sample_states
from popl_rl.raters.groups import make_groups
from popl_rl.raters.people import Raters
from popl_rl.testing import check_env as check_ours

ONE_D = ("zeroed", "doubled", "coin", "plain", "cycle_0", "cycle_third", "cycle_two_thirds")


def rows(states, coins=0.0):
    """Segments of one state each."""
    states = torch.as_tensor(states)
    coin = torch.as_tensor(coins).expand(len(states))
    data = {"observation": states[:, None, None], "info": {"coin": coin[:, None]}}
    return TensorDict(data, [len(states), 1])


def collect(num_segments=512, length=1, seed=0, **arguments):
    return collect_segments(
        lambda: hidden_utility(**arguments),
        {"random": random_behaviour(hidden_utility(**arguments).action_space)},
        num_segments=num_segments,
        length=length,
        generator=torch.Generator().manual_seed(seed),
        max_steps=64,
        num_envs=8,
    )


class Spied(HiddenUtility):
    """Remembers which coin was drawn with which state."""

    drawn = {}

    def _drawn(self):
        state, coin = super()._drawn()
        self.drawn[state.tobytes()] = coin
        return state, coin


@pytest.mark.parametrize("length", [1, 3, 20])
def test_a_row_of_a_segment_holds_the_coin_of_its_own_state(length):
    segments = collect_segments(
        Spied,
        {"random": random_behaviour(Spied().action_space)},
        num_segments=50,
        length=length,
        generator=torch.Generator().manual_seed(0),
        max_steps=40,
        num_envs=3,
    )
    states = segments["observation"].flatten(0, 1).numpy()
    coins = segments["info", "coin"].flatten()
    assert len(coins) == 50 * length
    assert [Spied.drawn[state.tobytes()] for state in states] == coins.tolist()


def test_info_at_reset_and_after_a_step():
    env = hidden_utility()
    state, info = env.reset(seed=3)
    after, reward, terminated, truncated, outcome = env.step(0)
    assert outcome == info
    assert isinstance(outcome["coin"], np.float32)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert state.dtype == after.dtype == np.float32
    assert state != after
    assert env.step(0)[4] != info


def test_episodes_end_by_their_length_alone():
    env = hidden_utility(max_steps=3)
    for _ in range(2):
        env.reset(seed=0)
        outcomes = [env.step(0) for _ in range(3)]
        assert [outcome[2] for outcome in outcomes] == [False] * 3
        assert [outcome[3] for outcome in outcomes] == [False, False, True]


def test_a_seed_repeats_episodes_and_another_does_not():
    def episode(env, seed):
        return [env.reset(seed=seed)[0], *(env.step(0)[0] for _ in range(5)), env.reset()[0]]

    first, second = hidden_utility(dimensions=3), hidden_utility(dimensions=3)
    assert np.array_equal(episode(first, 7), episode(second, 7))
    assert not np.equal(episode(first, 7), episode(second, 8)).any()


def test_what_one_does_changes_nothing_and_there_is_nothing_to_do():
    env = hidden_utility()
    assert env.action_space.n == 1
    env.reset(seed=0)
    for action in (1, -1):
        with pytest.raises(ValueError, match=r"action must be 0, the only one, got -?1"):
            env.step(action)


@pytest.mark.parametrize("dimensions", [1, 2, 5])
def test_it_keeps_what_is_asked_of_environments(dimensions):
    check_ours(hidden_utility, dimensions=dimensions)
    check_ours(hidden_utility, dimensions=dimensions, max_steps=3)
    check_env(hidden_utility(dimensions=dimensions), skip_render_check=True)


def test_gymnasium_knows_it():
    env = gymnasium.make("popl_rl/HiddenUtility-v0", dimensions=2, max_steps=7)
    assert env.observation_space.shape == (2,)
    assert env.unwrapped.max_steps == 7
    assert env.spec.entry_point == "popl_rl.envs.hidden_utility:HiddenUtility"


def test_it_pickles():
    env = pickle.loads(pickle.dumps(hidden_utility(dimensions=2)))
    assert env.reset(seed=1)[0].shape == (2,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dimensions": 0}, "dimensions must be at least 1, got 0"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"render_mode": "human"}, r"render_mode must be None \(nothing is drawn\), got 'human'"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        hidden_utility(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"count": 1, "dimensions": 0}, "dimensions must be at least 1, got 0"),
        ({"count": 1, "length": -1}, "length must be at least 1, got -1"),
    ],
)
def test_bad_counts_of_states(arguments, message, generator):
    with pytest.raises(ValueError, match=message):
        sample_states(arguments.pop("count"), generator=generator, **arguments)


# Data


def uniform(numbers):
    assert (numbers >= 0).all()
    assert (numbers < 1).all()
    assert kstest(numbers.flatten().numpy(), "uniform").pvalue > 1e-3


def drawn(count):
    return sample_states(count, dimensions=2, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    "segments", [collect(4096, dimensions=2), drawn(4096)], ids=["steps", "drawn"]
)
def test_states_and_coins_are_uniform_and_independent(segments):
    numbers = torch.cat(
        [segments["observation"][:, 0], segments["info", "coin"], segments["observation"][:, 0]], 1
    )
    for column in numbers[:, :3].T:
        uniform(column)
    # Correlations have a standard deviation of 1/64; neighbours in the data are no exception.
    assert (torch.corrcoef(numbers[:, :3].T) - torch.eye(3)).abs().max() < 0.07
    assert torch.corrcoef(torch.stack([numbers[1:, 0], numbers[:-1, 0]]))[0, 1].abs() < 0.07
    assert len(numbers[:, 0].unique()) > 4090


def test_states_of_a_segment_are_independent():
    first, second = collect(2048, length=2)["observation"][..., 0].T
    uniform(first)
    uniform(second)
    assert torch.corrcoef(torch.stack([first, second]))[0, 1].abs() < 0.1


@pytest.mark.parametrize("length", [1, 4])
def test_drawn_states_have_the_form_of_collected_segments(length, generator):
    stepped = collect(16, length=length, dimensions=2)
    drawn = sample_states(16, dimensions=2, length=length, generator=generator)
    assert drawn.batch_size == stepped.batch_size == (16, length)
    assert set(drawn.keys(True, True)) == set(stepped.keys(True, True))
    for key in drawn.keys(True, True):
        assert drawn[key].dtype == stepped[key].dtype
        assert drawn[key].shape == stepped[key].shape
        assert drawn[key].is_contiguous()
    for key in ("action", "reward"):
        assert not drawn[key].any()
        assert not stepped[key].any()


def test_data_are_repeated_by_a_seed():
    for make in (
        lambda seed: collect(64, seed=seed),
        lambda seed: sample_states(64, generator=torch.Generator().manual_seed(seed)),
    ):
        assert (make(0) == make(0)).all()
        assert not (make(0)["observation"] == make(1)["observation"]).any()


def test_long_segments_are_cut_from_long_episodes():
    env = hidden_utility()
    act = random_behaviour(env.action_space)
    episodes = lockstep([env], lambda step: act(step, None), seeds=[0], max_steps=2000)
    assert episodes.shape == (1, 1000)


# Raters


def evaluated(name, segments):
    return registry.resolve("rater", name)(segments)


@pytest.mark.parametrize(
    ("name", "coin", "expected"),
    [
        ("zeroed", 0.3, [0.0, 0.5, 0.75, 0.0, 0.0]),
        ("doubled", 0.3, [0.0, 0.5, 0.75, 1.6, 1.8]),
        ("coin", 0.3, [0.0, 0.5, 0.75, 1.6, 1.8]),
        ("coin", 0.5, [0.0, 0.5, 0.75, 0.0, 0.0]),
        ("plain", 0.5, [0.0, 0.5, 0.75, 0.8, 0.9]),
        ("cycle_0", 0.5, [0.0, 0.5, 0.75, 0.8, 0.9]),
        ("cycle_third", 0.5, [1 / 3, 5 / 6, 1 / 12, 2 / 15, 7 / 30]),
        ("cycle_two_thirds", 0.5, [2 / 3, 1 / 6, 5 / 12, 7 / 15, 17 / 30]),
    ],
)
def test_utilities_by_hand(name, coin, expected):
    utility = evaluated(name, rows([0.0, 0.5, 0.75, 0.8, 0.9], coin))
    assert utility.shape == (5, 1)
    assert utility.dtype == torch.float32
    assert utility[:, 0].tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", ONE_D)
def test_only_the_first_coordinate_counts_and_segments_may_be_long(name, generator):
    wide = sample_states(20, dimensions=3, length=4, generator=generator)
    flat = wide.clone()
    flat["observation"] = flat["observation"][..., :1]
    assert evaluated(name, wide).shape == (20, 4)
    assert torch.equal(evaluated(name, wide), evaluated(name, flat))


@pytest.mark.parametrize("name", ONE_D)
def test_the_coin_matters_to_nobody_but_the_one_who_throws_it(name, generator):
    segments = sample_states(200, generator=generator)
    other = segments.clone()
    other["info", "coin"] = 1 - other["info", "coin"]
    assert torch.equal(evaluated(name, segments), evaluated(name, other)) == (name != "coin")


def test_a_thrown_coin_is_worth_the_plain_state_on_average(generator):
    segments = sample_states(200_000, generator=generator)
    s, utility = segments["observation"].flatten(), evaluated("coin", segments).flatten()
    for low, high in pairwise([0.0, 0.4, 0.8, 0.9, 1.0]):
        chosen = (s >= low) & (s < high)
        assert utility[chosen].mean().item() == pytest.approx(s[chosen].mean().item(), abs=0.03)


@settings(deadline=None)
@given(st.integers(0, 2**20 - 1), st.sampled_from([0, 1, 2]))
def test_the_groups_of_a_circle_are_turned_against_each_other(grid, thirds):
    """A group wants at s what the first wants at s + thirds / 3, round the circle."""
    s = grid / 2**20
    name = ("cycle_0", "cycle_third", "cycle_two_thirds")[thirds]
    found = evaluated(name, rows([s])).item()
    assert 0 <= found < 1
    away = abs(found - (s + thirds / 3) % 1)
    assert min(away, 1 - away) < 1e-6


def test_groups_answer_as_persons_do(generator):
    """Both items of a comparison are judged by the rater's own group."""
    groups = make_groups(["zeroed", "doubled"], label="return")
    raters = Raters(groups, torch.tensor([0, 1]))
    segment_utility = raters.segment_utility(rows([0.5, 0.9, 0.7, 0.95]))
    pairs = torch.tensor([[0, 1], [0, 1], [1, 3], [1, 3], [0, 2], [0, 2]])
    answers = raters.answer(pairs, torch.tensor([0, 1] * 3), segment_utility, generator)
    assert answers.tolist() == [0, 1, 2, 1, 1, 1]


def test_all_names_are_known_without_an_import():
    assert set(ONE_D) <= set(registry.names("rater"))
    assert "hidden_utility" in registry.names("env")
    assert all(callable(registry.resolve("rater", name)) for name in ONE_D)


def test_places_on_a_ring_and_blends_by_hand():
    """0.5 + 3/4 wraps to 0.25; a quarter of 0.4 and three quarters of 0.8 are 0.7."""
    ring = registry.resolve("rater", "ring(3, 4)")
    one = TensorDict({"observation": torch.tensor([[[0.5]]])}, [1, 1])
    torch.testing.assert_close(ring(one), torch.tensor([[0.25]]))
    blend = registry.resolve("rater", "blend(0.25)")
    two = TensorDict({"observation": torch.tensor([[[0.4, 0.8]]])}, [1, 1])
    torch.testing.assert_close(blend(two), torch.tensor([[0.7]]))
    with pytest.raises(ValueError, match="2 coordinates"):
        blend(one)


def test_groups_of_one_function_have_names_of_their_own():
    groups = make_groups(["ring(0, 2)", "ring(1,2)"], label="return")
    assert [group.name for group in groups] == ["ring(0,2)", "ring(1,2)"]


def test_how_right_nobody_can_be_after_eight_answers(generator):
    """Who knows that all want a weighted mean, by any weight alike, is right in 0.956 of new pairs.

    Bayes' rule over 101 weights, and the mean of the weights that eight answers leave.
    """
    raters, weights = 1000, torch.linspace(0, 1, 101)

    def firsts(count):
        """Of pairs drawn for each rater: difference of the pair, in every weight's eyes."""
        states = sample_states(2 * count * raters, dimensions=2, generator=generator)
        ends = torch.stack([blend(states, weight) for weight in (0.0, 1.0)])
        apart = (ends[:, ::2] - ends[:, 1::2]).view(2, raters, count)
        return apart[0].unsqueeze(-1) + (apart[1] - apart[0]).unsqueeze(-1) * weights

    own = torch.randint(len(weights), (raters, 1, 1), generator=generator)
    asked, new = firsts(8), firsts(200)
    answered = asked.gather(2, own.expand(-1, 8, -1)) > 0
    left = ((asked > 0) == answered).all(1).float()
    believed = (left * weights).sum(1) / left.sum(1)
    guess = new[..., 0] + (new[..., -1] - new[..., 0]) * believed.unsqueeze(1)
    right = (guess > 0) == (new.gather(2, own.expand(-1, 200, -1)).squeeze(2) > 0)
    assert float(right.float().mean()) == pytest.approx(0.956, abs=0.004)
