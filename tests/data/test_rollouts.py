import gymnasium
import numpy as np
import pytest
import torch

from popl_rl.data.rollouts import MASK, lockstep, numeric_info
from popl_rl.testing import tiny_env


class Countdown(gymnasium.Env):
    """Lasts ``length`` steps; the observation is the time left, the reward the action."""

    observation_space = gymnasium.spaces.Box(0, 9, (1,), dtype=np.float32)
    action_space = gymnasium.spaces.Discrete(10)

    def __init__(self, length, *, truncates=False):
        self.length, self.truncates = length, truncates

    def reset(self, *, seed=None, **_options):
        self.left, self.seed = self.length, seed
        return np.array([self.left], dtype=np.float32), self.info()

    def step(self, action):
        assert self.left > 0, "stepped after the end"
        self.left -= 1
        over = self.left == 0
        observation = np.array([self.left], dtype=np.float32)
        ended = over and not self.truncates
        return observation, float(action), ended, over and self.truncates, self.info()

    def info(self):
        return {"left": self.left, "seed": self.seed, "name": "countdown"}


def always_zero(step):
    return torch.zeros(step.batch_size, dtype=torch.int64)


def half_throttle(step):
    return torch.full((*step.batch_size, 1), 0.5)


def test_only_plain_numbers_of_an_info_are_kept():
    info = {
        "int": 1,
        "float": 0.5,
        "bool": True,
        "np_int": np.int64(3),
        "np_float": np.float32(0.25),
        "np_bool": np.bool_(False),
        "text": "no",
        "array": np.zeros(2),
        "none": None,
        "nested": {"a": 1},
    }
    numbers = numeric_info(info)
    assert numbers == {
        "int": 1,
        "float": 0.5,
        "bool": True,
        "np_int": 3,
        "np_float": 0.25,
        "np_bool": False,
    }
    assert [type(value) for value in numbers.values()] == [int, float, bool, int, float, bool]


def test_two_episodes_by_hand():
    """Episodes of 1 and 3 steps; step t is given action t + 1 in both.

    The batch is as long as the longer one; after the end of the shorter there are zeros.
    """
    asked = []

    def act(step):
        asked.append((step["observation"][:, 0].tolist(), step["info", "left"].tolist()))
        return torch.full(step.batch_size, len(asked))

    envs = [Countdown(1), Countdown(3, truncates=True)]
    episodes = lockstep(envs, act, seeds=[7, 8], max_steps=10)
    assert episodes.batch_size == (2, 3)
    assert episodes["observation"].squeeze(-1).tolist() == [[1, 0, 0], [3, 2, 1]]
    assert episodes["action"].tolist() == [[1, 0, 0], [1, 2, 3]]
    assert episodes["reward"].tolist() == [[1, 0, 0], [1, 2, 3]]
    assert episodes["info", "left"].tolist() == [[0, 0, 0], [2, 1, 0]]
    assert episodes["info", "seed"].tolist() == [[7, 0, 0], [8, 8, 8]]
    assert episodes[MASK].tolist() == [[True, False, False], [True, True, True]]
    assert set(episodes["info"].keys()) == {"left", "seed"}
    assert episodes["observation"].dtype == episodes["reward"].dtype == torch.float32
    assert episodes["info", "left"].dtype == torch.int64
    # A policy sees what the last step led to, and is asked about ended episodes too.
    assert asked == [([1, 3], [1, 3]), ([0, 2], [0, 2]), ([0, 1], [0, 1])]


def test_infos_become_columns_of_three_kinds():
    class Kinds(Countdown):
        def info(self):
            return {
                "int": np.int8(self.left),
                "float": np.float64(0.5),
                "bool": np.bool_(True),
                "text": "no",
            }

    info = lockstep([Kinds(2), Kinds(1)], always_zero, seeds=[0, 1], max_steps=4)["info"]
    assert {name: value.dtype for name, value in info.items()} == {
        "int": torch.int64,
        "float": torch.float32,
        "bool": torch.bool,
    }
    assert info["int"].tolist() == [[1, 0], [0, 0]]
    assert info["float"].tolist() == [[0.5, 0.5], [0.5, 0.0]]
    assert info["bool"].tolist() == [[True, True], [True, False]]


def test_an_episode_is_cut_after_max_steps():
    episodes = lockstep([Countdown(9)], always_zero, seeds=[0], max_steps=4)
    assert episodes[MASK].tolist() == [[True] * 4]
    assert episodes["info", "left"].tolist() == [[8, 7, 6, 5]]


def test_together_is_as_alone():
    """Each environment of a batch does what it does alone, whatever the others do."""

    def act(step):
        return (step["info", "next_state"] % 2).long()

    lengths, seeds = [2, 6, 4], [11, 12, 13]
    envs = [tiny_env(max_steps=length) for length in lengths]
    together = lockstep(envs, act, seeds=seeds, max_steps=5)
    for index, length in enumerate(lengths):
        alone = lockstep(
            [tiny_env(max_steps=length)], act, seeds=seeds[index : index + 1], max_steps=5
        )
        steps = alone.shape[1]
        assert steps == min(length, 5)
        for key in alone.keys(True, True):
            assert torch.equal(together[index : index + 1, :steps][key], alone[key])
            assert not together[index, steps:][key].any()


def test_continuous_actions():
    env = gymnasium.make("Pendulum-v1")
    episodes = lockstep([env], half_throttle, seeds=[0], max_steps=3)
    assert episodes["action"].shape == (1, 3, 1)
    assert episodes["action"].unique().tolist() == [0.5]
    assert episodes["info"].is_empty()


@pytest.mark.parametrize(
    ("count", "seeds", "max_steps", "message"),
    [
        (0, [], 3, "envs must hold at least one environment, got none"),
        (2, [1], 3, r"seeds must be one per environment \(2\), got 1"),
        (1, [1], 0, "max_steps must be at least 1, got 0"),
    ],
)
def test_lockstep_refuses(count, seeds, max_steps, message):
    envs = [tiny_env() for _ in range(count)]
    with pytest.raises(ValueError, match=message):
        lockstep(envs, always_zero, seeds=seeds, max_steps=max_steps)
