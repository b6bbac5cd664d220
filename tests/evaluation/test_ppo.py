import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl.evaluation.ppo import reward_of, train_ppo
from popl_rl.evaluation.ppo_episodes import Ending, roll_episodes, running_returns
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.reward_set import RewardSet
from popl_rl.testing import tiny_env

SPEC = PolicySpec(5, 2, discrete=True, hidden=(8,))
QUICK = {"frames": 200, "frames_per_batch": 100, "num_envs": 5, "max_steps": 20, "epochs": 2}


def be_left(steps):
    """1 at the left end, 0 elsewhere; the action does not matter."""
    return steps["observation"][..., 0]


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def probabilities(population):
    """Of going left and right in each of the five cells."""
    return population(torch.eye(5))[0].softmax(-1)


class Slide(gymnasium.Env):
    """A point in [-1, 1] that moves by its action, clipped to the same bounds."""

    def __init__(self):
        self.observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.place = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.place, {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.place = np.clip(self.place + action, -1, 1)
        return self.place, 0.0, False, False, {}


class Stairs(gymnasium.Env):
    """Counts its steps; ends after ``steps``, terminated or truncated."""

    def __init__(self, steps, *, terminates):
        self.observation_space = gymnasium.spaces.Box(0, 100, (1,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)
        self.steps, self.terminates = steps, terminates

    def reset(self, **_options):
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, _action):
        self.time += 1
        over = self.time >= self.steps
        observation = np.full(1, self.time, np.float32)
        return observation, 0.0, over and self.terminates, over and not self.terminates, {}


class Exit(gymnasium.Env):
    """A room in which to stay (action 0), or that one leaves for good (action 1)."""

    def __init__(self):
        self.observation_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(self, **_options):
        return np.ones(1, np.float32), {}

    def step(self, action):
        return np.ones(1, np.float32), 0.0, bool(action), False, {}


def test_it_goes_where_the_reward_is():
    seen = []
    policy = train_ppo(
        tiny_env,
        be_left,
        SPEC,
        frames=4000,
        frames_per_batch=400,
        num_envs=20,
        max_steps=20,
        epochs=4,
        minibatch=200,
        learning_rate=0.03,
        generator=seeded(0),
        progress=lambda frames, mean: seen.append((frames, mean)),
    )
    assert len(policy) == 1
    assert (probabilities(policy)[:, 0] > 0.8).all()
    assert [frames for frames, _ in seen] == list(range(400, 4001, 400))
    # From a uniform start, 0 to 4 steps away, the best policy is at the left for 18 of 20 steps.
    assert seen[0][1] < 10
    assert 15 < seen[-1][1] <= 20
    assert PolicySet(policy).act(torch.eye(5), member=0, greedy=True).tolist() == [0] * 5


def test_the_scale_of_a_reward_does_not_matter():
    small, large = (
        train_ppo(
            tiny_env,
            lambda steps, scale=scale: scale * be_left(steps),
            SPEC,
            generator=seeded(0),
            **QUICK,
        )
        for scale in (2.0**-10, 2.0**10)
    )
    torch.testing.assert_close(probabilities(small), probabilities(large))


def test_a_reward_without_differences_is_survived():
    policy = train_ppo(
        tiny_env, lambda steps: torch.zeros(steps.shape), SPEC, generator=seeded(0), **QUICK
    )
    assert probabilities(policy).isfinite().all()


def test_seeds():
    torch.manual_seed(0)
    one = train_ppo(tiny_env, be_left, SPEC, generator=seeded(0), **QUICK)
    torch.manual_seed(1)
    before = torch.get_rng_state()
    again = train_ppo(tiny_env, be_left, SPEC, generator=seeded(0), **QUICK)
    assert torch.equal(before, torch.get_rng_state())
    other = train_ppo(tiny_env, be_left, SPEC, generator=seeded(1), **QUICK)
    for key, value in one.members.items(True, True):
        assert torch.equal(value, again.members[key])
        assert not torch.equal(value, other.members[key])


def test_continuous_actions_stay_in_bounds_and_learn():
    """Where the reward is the place before the step, moving right is right."""
    actions = []

    def be_right(steps):
        actions.append(steps["action"].flatten())
        return steps["observation"][..., 0]

    spec = PolicySpec.from_env(Slide(), hidden=(8,))
    policy = train_ppo(
        Slide,
        be_right,
        spec,
        frames=2000,
        frames_per_batch=400,
        num_envs=20,
        max_steps=20,
        epochs=4,
        minibatch=200,
        learning_rate=0.05,
        generator=seeded(0),
    )
    assert torch.cat(actions).abs().max() == 1
    mean = policy(torch.linspace(-1, 1, 5).unsqueeze(-1))[0]
    assert mean.shape == (5, 1)
    assert (mean > 0.2).all()


@pytest.mark.parametrize(("gain", "leaves"), [(1.0, False), (-1.0, True)])
def test_a_constant_decides_whether_an_episode_should_end(gain, leaves):
    """Which it would not if rewards were centred, or if being cut off were an end."""
    policy = train_ppo(
        Exit,
        lambda steps: torch.full(steps.shape, gain),
        PolicySpec(1, 2, discrete=True, hidden=(8,)),
        frames=800,
        frames_per_batch=100,
        num_envs=40,
        max_steps=5,
        epochs=4,
        minibatch=100,
        learning_rate=0.05,
        generator=seeded(0),
    )
    probability = policy(torch.ones(1, 1))[0, 0].softmax(-1)
    assert probability[int(leaves)] > 0.9


@pytest.mark.parametrize(("terminates", "steps"), [(True, 3), (False, 3), (True, 9)])
def test_how_episodes_end(terminates, steps):
    envs = [Ending(Stairs(steps, terminates=terminates)) for _ in range(2)]
    zero = torch.zeros(2, dtype=torch.long)
    rolled = roll_episodes(envs, lambda _: zero, be_left, max_steps=5, generator=seeded(0))
    length = min(steps, 5)
    count = torch.arange(length).repeat(2).unsqueeze(-1)
    last = count == length - 1
    assert torch.equal(rolled["observation"], count.float())
    assert torch.equal(rolled["next", "observation"], count.float() + 1)
    assert torch.equal(rolled["next", "reward"], count.float())
    assert torch.equal(rolled["next", "done"], last)
    assert torch.equal(rolled["next", "terminated"], last & (terminates and steps <= 5))


def test_running_returns_start_anew_with_each_episode():
    gain = torch.tensor([1.0, 2.0, 4.0, 8.0])
    done = torch.tensor([False, True, False, True])
    returns = running_returns(gain, done, 0.5)
    assert returns.squeeze(-1).tolist() == [1.0, 2.5, 4.0, 10.0]


def test_reward_of_discrete_actions():
    rewards = RewardSet(Population.create(RewardSpec(5, 2), 3, generator=seeded(0)))
    observation, action = torch.eye(5), torch.tensor([0, 1, 1, 0, 1])
    gain = reward_of(rewards, 2)(
        TensorDict({"observation": observation, "action": action}, [len(action)])
    )
    assert torch.equal(gain, rewards.reward(observation)[2, torch.arange(5), action])


def test_reward_of_continuous_actions():
    rewards = RewardSet(Population.create(RewardSpec(3), 2, generator=seeded(0)))
    observation, action = torch.rand(4, 2), torch.rand(4, 1)
    gain = reward_of(rewards, 1)(
        TensorDict({"observation": observation, "action": action}, [len(action)])
    )
    expected = rewards.reward(torch.cat([observation, action], -1))[1, :, 0]
    torch.testing.assert_close(gain, expected)


def test_training_on_a_set():
    rewards = RewardSet(Population.create(RewardSpec(2), 1, generator=seeded(0)))
    spec = PolicySpec.from_env(Slide(), hidden=(8,))
    policy = train_ppo(Slide, reward_of(rewards, 0), spec, generator=seeded(0), **QUICK)
    assert policy(torch.zeros(1, 1)).isfinite().all()


@pytest.mark.parametrize("member", [-1, 2])
def test_no_such_member(member):
    rewards = RewardSet(Population.create(RewardSpec(5, 2), 2, generator=seeded(0)))
    with pytest.raises(IndexError, match=rf"member must be in 0\.\.1, got {member}"):
        reward_of(rewards, member)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("frames", 0, "frames must be at least 1, got 0"),
        ("frames_per_batch", 0, "frames_per_batch must be at least 1"),
        ("num_envs", 0, "num_envs must be at least 1"),
        ("max_steps", 0, "max_steps must be at least 1"),
        ("epochs", 0, "epochs must be at least 1"),
        ("minibatch", 0, "minibatch must be at least 1"),
        ("discount", 1.1, r"discount must be in \[0, 1\], got 1.1"),
        ("gae_lambda", -0.1, r"gae_lambda must be in \[0, 1\]"),
        ("clip_epsilon", 0.0, "clip_epsilon must be positive"),
        ("learning_rate", float("nan"), "learning_rate must be positive, got nan"),
        ("entropy", -1.0, "entropy must be 0 or positive, got -1.0"),
    ],
)
def test_numbers_out_of_range(name, value, message):
    with pytest.raises(ValueError, match=message):
        train_ppo(tiny_env, be_left, SPEC, generator=seeded(0), **{**QUICK, name: value})


@pytest.mark.parametrize(
    ("reward", "error", "message"),
    [
        (lambda s: be_left(s).log(), ValueError, "reward must give finite values, got .* infinite"),
        (
            lambda s: s["observation"][..., :1],
            ValueError,
            r"reward must give one value .*\[5, 20\], got \[5, 20, 1\]",
        ),
        (
            lambda s: s["action"],
            TypeError,
            r"reward must give a floating-point tensor, got torch\.int64",
        ),
        (lambda _: 1.0, TypeError, "reward must give a floating-point tensor, got float"),
    ],
)
def test_rewards_that_are_none(reward, error, message):
    with pytest.raises(error, match=message):
        train_ppo(tiny_env, reward, SPEC, generator=seeded(0), **QUICK)


def test_a_spec_of_another_environment():
    spec = PolicySpec(5, 3, discrete=True, hidden=(8,))
    with pytest.raises(ValueError, match=r"spec must be that of the environment, .*action_dim=2"):
        train_ppo(tiny_env, be_left, spec, generator=seeded(0), **QUICK)
