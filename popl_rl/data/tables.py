"""Exact planning in a small environment whose every transition is listed in a ``Table``.

An environment that can list its transitions gives raters exact optimal advantages (labels by
regret) and gives an evaluation exact returns, without a rollout.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD

__all__ = ["Table", "policy_return", "solve"]

_TOLERANCE = 1e-10
_MAX_SWEEPS = 10_000


@dataclass(frozen=True, eq=False)
class Table:
    """Every transition of a deterministic environment with S states and A actions.

    Attributes:
        steps: TensorDict of batch size ``[S, A]``: every (state, action) as the one step it is,
            under the keys of a segment (see ``popl_rl.keys``), so that a rater judges a table with
            the code that judges segments. ``("info", "state")`` is the index of the state.
        next_state: ``[S, A]`` int64, the state that follows. Where the step is terminal nothing
            acts in it.
        terminal: ``[S, A]`` bool, whether the step ends the episode.
        start: ``[S]`` probabilities of the first state, summing to one.
        horizon: Steps after which the environment itself cuts an episode, ``math.inf`` if never.
            With it the table says all that stepping does, its ``info`` included, so that episodes
            are looked up instead (see ``popl_rl.data.table_rollouts``). None if that depends on
            anything else: then environments are stepped.

    Raises:
        ValueError: If a shape does not match ``steps``, a key is missing, an index is out of range,
            ``start`` is no distribution, or ``horizon`` is below 1.
        TypeError: If ``next_state`` is not int64 or ``terminal`` not bool.
    """

    steps: TensorDict
    next_state: Tensor
    terminal: Tensor
    start: Tensor
    horizon: float | None = None

    def __post_init__(self) -> None:
        if len(self.steps.batch_size) != 2:
            raise ValueError(
                f"steps must have batch size [states, actions], got {list(self.steps.batch_size)}."
            )
        states, actions = self.steps.batch_size
        state_key = (INFO, "state")
        for key in (OBSERVATION, ACTION, REWARD, state_key):
            if key not in self.steps.keys(include_nested=True):
                raise ValueError(f"steps must hold {key!r}, as segments do; it does not.")
        expected = {
            "next_state": (self.next_state, (states, actions)),
            "terminal": (self.terminal, (states, actions)),
            "start": (self.start, (states,)),
            'steps["action"]': (self.steps[ACTION], (states, actions)),
            'steps["reward"]': (self.steps[REWARD], (states, actions)),
            'steps["info", "state"]': (self.steps[state_key], (states, actions)),
        }
        for name, (tensor, shape) in expected.items():
            if tuple(tensor.shape) != shape:
                raise ValueError(f"{name} must have shape {list(shape)}, got {list(tensor.shape)}.")
        if self.steps[OBSERVATION].ndim != 3:
            raise ValueError(
                'steps["observation"] must have shape [states, actions, features], got '
                f"{list(self.steps[OBSERVATION].shape)}."
            )
        if self.next_state.dtype != torch.int64:
            raise TypeError(f"next_state must be int64, got {self.next_state.dtype}.")
        if self.terminal.dtype != torch.bool:
            raise TypeError(f"terminal must be bool, got {self.terminal.dtype}.")
        if bool((self.next_state < 0).any()) or bool((self.next_state >= states).any()):
            raise ValueError(
                f"next_state must lie in 0..{states - 1}, got values from "
                f"{int(self.next_state.min())} to {int(self.next_state.max())}."
            )
        own = torch.arange(states, device=self.next_state.device).unsqueeze(1)
        if not bool((self.steps[state_key] == own).all()):
            raise ValueError('steps["info", "state"] must be the index of its own row everywhere.')
        if self.horizon is not None and not self.horizon >= 1:
            raise ValueError(f"horizon must be at least 1, got {self.horizon}.")
        if bool((self.start < 0).any()) or abs(float(self.start.double().sum()) - 1) > 1e-5:
            raise ValueError(
                f"start must be probabilities that sum to 1, got sum {float(self.start.sum()):g} "
                f"and minimum {float(self.start.min()):g}."
            )


def solve(
    table: Table, reward: Tensor, *, discount: float = 0.97, temperature: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Solve a table for a reward by value iteration, in float64.

    With a positive temperature the policy is rewarded for its entropy, so that ``V = temperature *
    logsumexp(Q / temperature)`` and ``(Q - V) / temperature`` is the log-probability of its actions
    (Ziebart, 2010; the reading of advantages that CPL, arXiv 2310.13639, is derived from).

    Args:
        table: The transitions.
        reward: ``[S, A]`` float, what each step is worth.
        discount: Factor of the next step's value relative to this one's, in (0, 1].
        temperature: Weight of the entropy; 0 takes the best action.

    Returns:
        Advantages ``Q - V`` of shape ``[S, A]`` and values ``V`` of shape ``[S]``, in the dtype of
        ``reward``.

    Raises:
        ValueError: If the reward is of another shape or not finite, an argument is out of range, or
            the values do not converge (a discount of 1 in an environment that can go on for ever).
        TypeError: If the reward is not floating-point.
    """
    _check_reward(table, reward)
    if not 0 < discount <= 1:
        raise ValueError(f"discount must be in (0, 1], got {discount}.")
    if not 0 <= temperature < float("inf"):
        raise ValueError(f"temperature must be 0 (hard maximum) or positive, got {temperature}.")
    gain = reward.double()
    future = discount * (~table.terminal).double()
    values = gain.new_zeros(len(gain))
    for _ in range(_MAX_SWEEPS):
        q = gain + future * values[table.next_state]
        updated = temperature * torch.logsumexp(q / temperature, 1) if temperature else q.amax(1)
        # Relative, because float64 cannot hold values of 1e9 to an absolute 1e-10.
        limit = _TOLERANCE * max(1.0, float(updated.abs().max()))
        if (updated - values).abs().max() <= limit:
            # Q less its own maximum, so that a best action's advantage is exactly zero.
            return (q - updated.unsqueeze(1)).to(reward.dtype), updated.to(reward.dtype)
        values = updated
    raise ValueError(
        f"value iteration did not converge in {_MAX_SWEEPS} sweeps: with discount={discount} the "
        "values grow without end or too slowly; take a smaller discount."
    )


def expected_visits(table: Table, probabilities: Tensor, *, horizon: int) -> Tensor:
    """How often a policy takes each step in an episode, exactly, see ``policy_return``.

    Args:
        table: The transitions.
        probabilities: ``[S, A]``, the policy: each row sums to one.
        horizon: Number of steps after which an episode is cut off.

    Returns:
        ``[S, A]`` float64. Its product with any reward of steps is the policy's return.
    """
    policy = probabilities.double()
    visits = torch.zeros_like(policy)
    for flow in _flows(table, policy / policy.sum(1, keepdim=True), horizon=horizon):
        visits += flow
    return visits


def policy_return(table: Table, probabilities: Tensor, reward: Tensor, *, horizon: int) -> float:
    """Return a policy's expected undiscounted return over an episode, exactly.

    The distribution of states is carried forward from ``table.start`` in float64; an episode ends
    with a terminal step or after ``horizon`` steps.

    Args:
        table: The transitions.
        probabilities: ``[S, A]``, the policy: each row sums to one.
        reward: ``[S, A]`` float, what each step is worth.
        horizon: Number of steps after which an episode is cut off, at least 1.

    Raises:
        ValueError: If a shape differs, a row of ``probabilities`` is no distribution, the reward is
            not finite or the horizon is below 1.
        TypeError: If the reward is not floating-point.
    """
    _check_reward(table, reward)
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}.")
    if probabilities.shape != table.next_state.shape:
        raise ValueError(
            "probabilities must have the table's shape "
            f"{list(table.next_state.shape)}, got {list(probabilities.shape)}."
        )
    policy = probabilities.double()
    # Rows are rounded to the dtype they came in; what is left over would leak probability at every
    # step.
    total = policy.sum(1, keepdim=True)
    if not bool((policy >= 0).all()) or not bool(((total - 1).abs() <= 1e-4).all()):
        raise ValueError(
            "each row of probabilities must be non-negative and sum to 1; use softmax(-1), got row "
            f"sums from {float(total.min()):g} to {float(total.max()):g}."
        )
    gain = reward.double()
    result = 0.0
    for flow in _flows(table, policy / total, horizon=horizon):
        result += float((flow * gain).sum())
    return result


def _flows(table: Table, policy: Tensor, *, horizon: int) -> Iterator[Tensor]:
    """How often each step of an episode is taken, ``[S, A]``, first step, second step and so on."""
    alive = table.start.double()
    alive = alive / alive.sum()
    for _ in range(horizon):
        flow = alive.unsqueeze(1) * policy
        yield flow
        flow = flow.masked_fill(table.terminal, 0.0)
        alive = torch.zeros_like(alive).index_add_(0, table.next_state.flatten(), flow.flatten())


def _check_reward(table: Table, reward: Tensor) -> None:
    if reward.shape != table.next_state.shape:
        raise ValueError(
            f"reward must have the table's shape {list(table.next_state.shape)}, got "
            f"{list(reward.shape)}."
        )
    if not reward.is_floating_point():
        raise TypeError(f"reward must be floating-point, got {reward.dtype}; call .float() on it.")
    if not bool(reward.isfinite().all()):
        raise ValueError(
            f"reward must be finite, got {int((~reward.isfinite()).sum())} NaN or infinite values."
        )
