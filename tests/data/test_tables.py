"""Planning on a chain of three states, worked by hand.

States 0, 1, 2; action 0 stays, action 1 goes on; going on from 2 ends the episode. Staying is worth
0, going on -1 from 0 and 1, and 10 from 2. With discount 0.5: V(2) = 10, V(1) = -1 + 5 = 4,
V(0) = -1 + 2 = 1.
"""

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from popl_rl.data.tables import Table, policy_return, solve

REWARD = torch.tensor([[0.0, -1.0], [0.0, -1.0], [0.0, 10.0]])


def make_table(next_state, terminal, start=None):
    states, actions = next_state.shape
    steps = TensorDict(
        {
            "observation": torch.eye(states).unsqueeze(1).repeat(1, actions, 1),
            "action": torch.arange(actions).repeat(states, 1),
            "reward": torch.zeros(states, actions),
            "info": {"state": torch.arange(states).unsqueeze(1).repeat(1, actions)},
        },
        batch_size=[states, actions],
    )
    start = torch.full((states,), 1 / states) if start is None else start
    return Table(steps, next_state, terminal, start)


@pytest.fixture
def chain():
    return make_table(
        torch.tensor([[0, 1], [1, 2], [2, 2]]),
        torch.tensor([[False, False], [False, False], [False, True]]),
        torch.tensor([1.0, 0.0, 0.0]),
    )


def test_hard_maximum_by_hand(chain):
    advantages, values = solve(chain, REWARD, discount=0.5)
    torch.testing.assert_close(values, torch.tensor([1.0, 4.0, 10.0]))
    expected = torch.tensor([[-0.5, 0.0], [-2.0, 0.0], [-5.0, 0.0]])
    torch.testing.assert_close(advantages, expected)


def test_best_actions_have_exactly_no_disadvantage(chain):
    advantages, _ = solve(chain, REWARD.double() / 3)
    assert advantages.dtype == torch.float64
    assert (advantages.amax(1) == 0).all()


def test_without_discount_an_episode_that_ends_is_solved(chain):
    _, values = solve(chain, REWARD - 0.5, discount=1.0)
    torch.testing.assert_close(values, torch.tensor([6.5, 8.0, 9.5]))


def test_maximum_entropy_by_hand():
    """One state, two actions that both end the episode: V = τ log(e^(1/τ) + e^(3/τ)) with τ = 2."""
    table = make_table(torch.zeros(1, 2, dtype=torch.int64), torch.ones(1, 2, dtype=torch.bool))
    advantages, values = solve(table, torch.tensor([[1.0, 3.0]]), temperature=2.0)
    expected = 2 * math.log(math.exp(0.5) + math.exp(1.5))
    assert values.item() == pytest.approx(expected)
    assert advantages.tolist()[0] == pytest.approx([1 - expected, 3 - expected])


def test_maximum_entropy_that_goes_on_by_hand():
    """One state, two actions that stay, no reward: V = τ log 2 + γ V."""
    table = make_table(torch.zeros(1, 2, dtype=torch.int64), torch.zeros(1, 2, dtype=torch.bool))
    _, values = solve(table, torch.zeros(1, 2), discount=0.9, temperature=0.5)
    assert values.item() == pytest.approx(0.5 * math.log(2) / 0.1)


def test_return_by_hand(chain):
    """Staying half the time is worth -1/2 in steps 1 and 2, in which the walker is in 0 or 1.

    Before step 3 a quarter is in 0, half in 1 (-3/8 together) and a quarter in 2 (10/8).
    """
    half = torch.full((3, 2), 0.5)
    assert policy_return(chain, half, REWARD, horizon=1) == pytest.approx(-0.5)
    assert policy_return(chain, half, REWARD, horizon=2) == pytest.approx(-1.0)
    assert policy_return(chain, half, REWARD, horizon=3) == pytest.approx(-1.0 - 0.375 + 1.25)


def test_nothing_is_earned_after_a_terminal_step(chain):
    go = torch.tensor([[0.0, 1.0]]).repeat(3, 1)
    assert policy_return(chain, go, REWARD, horizon=3) == pytest.approx(8.0)
    assert policy_return(chain, go, REWARD, horizon=50) == pytest.approx(8.0)


def test_return_agrees_with_simulation(chain):
    generator = torch.Generator().manual_seed(0)
    policy = torch.tensor([[0.3, 0.7], [0.6, 0.4], [0.2, 0.8]])
    state = torch.zeros(20_000, dtype=torch.int64)
    alive = torch.ones(20_000, dtype=torch.bool)
    total = torch.zeros(20_000)
    for _ in range(6):
        action = torch.multinomial(policy[state], 1, generator=generator).squeeze(1)
        total += REWARD[state, action] * alive
        alive = alive & ~chain.terminal[state, action]
        state = chain.next_state[state, action]
    error = total.std().item() / math.sqrt(len(total))
    exact = policy_return(chain, policy, REWARD, horizon=6)
    assert total.mean().item() == pytest.approx(exact, abs=4 * error)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1, 1.0]))
def test_values_satisfy_the_bellman_equation(seed, temperature):
    generator = torch.Generator().manual_seed(seed)
    next_state = torch.randint(6, (6, 3), generator=generator)
    terminal = torch.rand(6, 3, generator=generator) < 0.2
    table = make_table(next_state, terminal)
    reward = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    advantages, values = solve(table, reward, discount=0.9, temperature=temperature)
    q = reward + 0.9 * values[next_state] * ~terminal
    torch.testing.assert_close(advantages, q - values.unsqueeze(1), atol=1e-8, rtol=0)
    if temperature:
        total = (advantages / temperature).exp().sum(1)
    else:
        total = (advantages == 0).any(1).double()
    torch.testing.assert_close(total, torch.ones(6, dtype=torch.float64))


def test_values_that_grow_without_end_are_an_error(chain):
    with pytest.raises(ValueError, match=r"did not converge.*smaller discount"):
        solve(chain, torch.ones(3, 2), discount=1.0)


@pytest.mark.parametrize(
    ("reward", "options", "error", "message"),
    [
        (torch.zeros(2, 2), {}, ValueError, r"table's shape \[3, 2\], got \[2, 2\]"),
        (torch.zeros(3, 2, dtype=torch.int64), {}, TypeError, "floating-point, got torch.int64"),
        (torch.full((3, 2), torch.nan), {}, ValueError, "finite, got 6 NaN"),
        (torch.zeros(3, 2), {"discount": 1.5}, ValueError, "discount must be in"),
        (torch.zeros(3, 2), {"discount": 0.0}, ValueError, "discount must be in"),
        (torch.zeros(3, 2), {"temperature": -1.0}, ValueError, "temperature must be"),
        (torch.zeros(3, 2), {"temperature": math.nan}, ValueError, "temperature must be"),
    ],
)
def test_bad_arguments_of_solve(chain, reward, options, error, message):
    with pytest.raises(error, match=message):
        solve(chain, reward, **options)


@pytest.mark.parametrize(
    ("probabilities", "horizon", "message"),
    [
        (torch.full((3, 2), 0.5), 0, "horizon must be at least 1, got 0"),
        (torch.full((3, 3), 1 / 3), 5, "probabilities must have the table's shape"),
        (torch.ones(3, 2), 5, "sum to 1; use softmax.*from 2 to 2"),
        (torch.tensor([[-1.0, 2.0]] * 3), 5, "non-negative"),
        (torch.full((3, 2), torch.nan), 5, "non-negative"),
    ],
)
def test_bad_arguments_of_policy_return(chain, probabilities, horizon, message):
    with pytest.raises(ValueError, match=message):
        policy_return(chain, probabilities, REWARD, horizon=horizon)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"next_state": torch.zeros(3, 3, dtype=torch.int64)}, ValueError, r"next_state.*\[3, 2\]"),
        ({"next_state": torch.zeros(3, 2)}, TypeError, "next_state must be int64"),
        ({"next_state": torch.full((3, 2), 3)}, ValueError, r"0\.\.2, got values from 3 to 3"),
        ({"terminal": torch.zeros(3, 2)}, TypeError, "terminal must be bool"),
        ({"terminal": torch.zeros(2, 2, dtype=torch.bool)}, ValueError, "terminal must have shape"),
        ({"start": torch.ones(3)}, ValueError, "sum to 1, got sum 3"),
        ({"start": torch.tensor([2.0, -1.0, 0.0])}, ValueError, "minimum -1"),
        ({"start": torch.ones(1)}, ValueError, r"start must have shape \[3\]"),
    ],
)
def test_bad_tables(chain, change, error, message):
    with pytest.raises(error, match=message):
        dataclasses.replace(chain, **change)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("observation", torch.zeros(3, 2), "observation.*features"),
        ("action", torch.zeros(3, 2, 1), "action.*must have shape"),
        (("info", "state"), torch.zeros(3, 2), "index of its own row"),
    ],
)
def test_bad_steps_of_a_table(chain, key, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(chain, steps=chain.steps.clone().set(key, value))


def test_steps_of_a_table_must_be_complete(chain):
    with pytest.raises(ValueError, match="steps must hold 'reward'"):
        dataclasses.replace(chain, steps=chain.steps.exclude("reward"))
    with pytest.raises(ValueError, match=r"batch size \[states, actions\], got \[3\]"):
        dataclasses.replace(chain, steps=chain.steps[:, 0])
