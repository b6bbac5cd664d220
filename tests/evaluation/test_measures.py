import math

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.measures import (
    group_accuracy,
    group_returns,
    held_out_pairs,
    info_rates,
    new_rater_answers,
    recovery,
    roll_out,
    success_rate,
)
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.response import Response
from popl_rl.testing import tiny_env


@pytest.fixture
def walkers():
    """A policy that walks left and one that walks right."""
    networks = []
    for bias in ([20.0, 0.0], [0.0, 20.0]):
        network = nn.Sequential(nn.Linear(5, 2))
        network.load_state_dict({"0.weight": torch.zeros(2, 5), "0.bias": torch.tensor(bias)})
        networks.append(network)
    return PolicySet(Population(networks, PolicySpec(5, 2, True, ())))


@pytest.fixture
def episodes():
    """One policy, two episodes of 3 and 2 steps; what follows an end is garbage."""
    info = {"door": [[-1, 0, 1], [-1, 1, 0]], "goal": [[0, 0, 1], [0, 0, 9]]}
    data = {
        "info": {key: torch.tensor([value]) for key, value in info.items()},
        "reward": torch.tensor([[[1.0, 2.0, 3.0], [10.0, 20.0, 99.0]]]),
        MASK: torch.tensor([[[True, True, True], [True, True, False]]]),
    }
    return TensorDict(data, [1, 2, 3])


def by_reward(segments):
    return segments["reward"]


def by_goal(segments):
    return segments["info", "goal"].float()


def test_returns_by_hand(episodes):
    """Rewards sum to 6 and 30 (the 99 comes after the end): mean 18. Goals: 1 and 0."""
    groups = [RaterGroup("r", by_reward, Response()), RaterGroup("g", by_goal, Response())]
    assert group_returns(episodes, groups).tolist() == [[18.0, 0.5]]


def logarithmic(segments):
    """Undefined where a reward is not positive, as after an episode's end."""
    return segments["reward"].log()


def test_groups_are_not_shown_what_stands_after_an_end(episodes):
    episodes["reward"][0, 1, 2] = 0.0
    groups = (RaterGroup("log", logarithmic, Response()),)
    expected = (math.log(1 * 2 * 3) + math.log(10 * 20)) / 2
    assert group_returns(episodes, groups).item() == pytest.approx(expected)
    assert episodes["reward"][0, 1].tolist() == [10.0, 20.0, 0.0]


def test_rates_by_hand(episodes):
    """No door and door 1 in both episodes; door 0 in the first, and after the second's end."""
    rates = info_rates(episodes, "door")
    found = {value: rate.tolist() for value, rate in rates.items()}
    assert found == {-1: [1.0], 0: [0.5], 1: [1.0]}


def test_success_by_hand(episodes):
    assert success_rate(episodes, "goal").tolist() == [0.5]
    assert success_rate(episodes, "nothing").isnan().tolist() == [True]


@pytest.mark.parametrize(
    ("value", "expected"), [(10.0, 1.0), (2.0, 0.0), (4.0, 0.25), (0.0, -0.25), (12.0, 1.25)]
)
def test_recovery_by_hand(value, expected):
    """Random gets 2 and the oracle 10, so one point of return is an eighth."""
    assert recovery(value, reference=2.0, oracle=10.0) == pytest.approx(expected)


@pytest.mark.parametrize("oracle", [2.0, 1.0, math.nan])
def test_nothing_to_recover(oracle):
    assert math.isnan(recovery(3.0, reference=2.0, oracle=oracle))


def test_group_accuracy_by_hand():
    """Policy 0 ranks segments 2, 1, 0 from the best; policy 1 finds 0 and 1 equal and 2 worst.

    Group 0 prefers 1 to 0 and 2 to 0: policy 0 is right twice; policy 1 once wrong and once tied,
    which is not right. Group 1 prefers 0 to 1, 0 to 2 and 1 to 2: none of three against two.
    """
    scores = torch.tensor([[0.0, 1.0, 2.0], [1.0, 1.0, 0.0]])
    pairs = {
        0: (torch.tensor([1, 2]), torch.tensor([0, 0])),
        1: (torch.tensor([0, 0, 1]), torch.tensor([1, 2, 2])),
    }
    expected = torch.tensor([[1.0, 0.0], [0.0, 2 / 3]])
    torch.testing.assert_close(group_accuracy(scores, pairs), expected)


def test_held_out_pairs_are_strict_and_ordered(generator):
    segment_utility = torch.tensor([[0.0, 0.0, 1.0, 2.0], [3.0, 2.0, 1.0, 0.0]])
    for group in (0, 1):
        better, worse = held_out_pairs(segment_utility, group, count=300, generator=generator)
        assert bool((segment_utility[group, better] > segment_utility[group, worse]).all())
        # Group 0 finds segments 0 and 1 equal: 2 of 12 ordered pairs are dropped.
        assert len(better) == 300 if group else 220 < len(better) < 280
        found = set(zip(better.tolist(), worse.tolist(), strict=True))
        assert len(found) == (6 if group else 5)


def test_a_set_that_knows_the_utility_is_right_everywhere(generator):
    segment_utility = torch.rand(2, 30, generator=generator)
    pairs = {g: held_out_pairs(segment_utility, g, count=200, generator=generator) for g in (0, 1)}
    accuracy = group_accuracy(torch.cat([segment_utility, -segment_utility]), pairs)
    assert accuracy.diagonal().tolist() == [1, 1]
    assert accuracy[2:].diagonal().tolist() == [0, 0]


def test_new_raters_answer_for_their_group(groups, segments, generator):
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    for group in (0, 1):
        answers = new_rater_answers(groups, group, segment_utility, answers=25, generator=generator)
        assert answers.batch_size == (25,)
        pair, answer = answers["pair"], answers["answer"]
        chosen = segment_utility[group, pair.gather(1, answer.unsqueeze(1)).squeeze(1)]
        other = segment_utility[group, pair.gather(1, 1 - answer.unsqueeze(1)).squeeze(1)]
        assert bool((chosen > other).all())


def test_new_raters_make_their_groups_mistakes(generator):
    groups = [RaterGroup("wrong", by_reward, Response(mistake=1.0))]
    answers = new_rater_answers(groups, 0, torch.arange(9.0)[None], answers=20, generator=generator)
    pair, answer = answers["pair"], answers["answer"]
    assert torch.equal(answer, pair.argmin(1))


def test_new_raters_who_never_choose_are_reported(generator):
    groups = [RaterGroup("calm", by_reward, Response(tie=100.0))]
    message = "a rater of group 'calm' gave 0 strict answers to 500 queries, too few to cater to"
    with pytest.raises(ValueError, match=message):
        new_rater_answers(groups, 0, torch.arange(9.0)[None], answers=5, generator=generator)


def test_policies_are_rolled_from_the_same_starts(walkers):
    """After t steps the left walker is at max(start - t, 0), the right one at min(start + t, 4)."""
    episodes = roll_out(
        lambda: tiny_env(max_steps=6), walkers, episodes=5, max_steps=9, seed=3, greedy=True
    )
    assert episodes.batch_size == (2, 5, 6)
    assert bool(episodes[MASK].all())
    start = episodes["info", "state"][:, :, :1]
    assert torch.equal(start[0], start[1])
    assert start.unique().numel() > 1
    time = torch.arange(1, 7)
    after = episodes["info", "next_state"]
    assert torch.equal(after[0], (start[0] - time).clamp(min=0))
    assert torch.equal(after[1], (start[1] + time).clamp(max=4))


def test_starts_do_not_depend_on_who_is_rolled(walkers):
    def starts(policies):
        episodes = roll_out(
            tiny_env, policies, episodes=4, max_steps=1, seed=1, random_action=random
        )
        return episodes["info", "state"][-1, :, 0].tolist()

    def random(step, generator):
        return torch.randint(2, step.batch_size, generator=generator)

    assert starts(walkers) == starts(walkers.subset([1])) == starts(None)


@pytest.mark.parametrize("greedy", [True, False])
def test_rolling_is_reproducible(greedy):
    population = Population.create(
        PolicySpec(5, 2, True, (4,)), 3, generator=torch.Generator().manual_seed(0)
    )

    def actions(seed):
        policies = PolicySet(population)
        episodes = roll_out(tiny_env, policies, episodes=4, max_steps=8, seed=seed, greedy=greedy)
        return episodes["action"]

    assert torch.equal(actions(1), actions(1))
    assert greedy or not torch.equal(actions(1), actions(2))


def test_continuous_policies_are_rolled(generator):
    population = Population.create(PolicySpec(3, 1, False, (4,)), 2, generator=generator)
    policies = PolicySet(population)
    make = lambda: gymnasium.make("Pendulum-v1")  # noqa: E731
    episodes = roll_out(make, policies, episodes=3, max_steps=4, seed=0)
    assert episodes["action"].shape == (2, 3, 4, 1)
    first = episodes["observation"][:, :, 0]
    assert torch.equal(first[0], first[1])
    expected = policies.act(first)
    torch.testing.assert_close(episodes["action"][:, :, 0], expected)


class Closable:
    """Counts how many environments are open."""

    open = 0

    def __call__(self):
        self.open += 1
        env = tiny_env()
        env.close = self.close
        return env

    def close(self):
        self.open -= 1


def test_environments_are_closed_whatever_happens(walkers):
    make = Closable()
    roll_out(make, walkers, episodes=2, max_steps=2, seed=0)
    assert make.open == 0
    with pytest.raises(ValueError, match="max_steps must be at least 1, got 0"):
        roll_out(make, walkers, episodes=2, max_steps=0, seed=0)
    assert make.open == 0


def test_rolling_refuses(walkers):
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        roll_out(tiny_env, walkers, episodes=0, max_steps=5, seed=0)
    with pytest.raises(ValueError, match="random_action must be given to roll without policies"):
        roll_out(tiny_env, None, episodes=1, max_steps=5, seed=0)
