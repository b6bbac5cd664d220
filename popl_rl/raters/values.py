"""What a state is worth to a group of raters, fitted on segments: for labels by regret.

Only data gathering and evaluation import this module; a learner never does.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import MLP

from popl_rl.keys import OBSERVATION
from popl_rl.optim import adam, take_step
from popl_rl.raters.groups import RaterGroup

__all__ = ["Value", "fit_value", "with_values"]

_ROUNDS = 12  # of fitting, then looking ahead anew
_HIDDEN = (64, 64)


class Value:
    """Worth of a state, ``[..., O] -> [...]``: what still comes, in the raters' own unit.

    Args:
        network: Of normalised observations, ``[..., O] -> [..., 1]``.
        mean: Mean of the observations, ``[O]``.
        std: Their standard deviation, ``[O]``.
        scale: What an output of 1 is worth.
    """

    def __init__(self, network: MLP, mean: Tensor, std: Tensor, scale: float) -> None:
        self.network, self.mean, self.std, self.scale = network, mean, std, scale

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Return the worth of states."""
        value: Tensor = self.network((observation - self.mean) / self.std).squeeze(-1) * self.scale
        return value


def fit_value(
    segments: TensorDictBase,
    utility: Tensor,
    *,
    steps: int = 100,
    batch_size: int = 1024,
    learning_rate: float = 3e-3,
    generator: torch.Generator,
) -> Value:
    """Fit the undiscounted value of acting as the data does.

    Returns to the end of a segment plus the value of its last state are what the states of the
    segment are worth; fitted and looked up in turn, so that worth travels back from segment to
    segment (fitted value iteration on n-step returns, Sutton and Barto, 2018, chapter 7).

    Args:
        segments: ``[N, T]`` with ``observation``.
        utility: The group's utility of each step, ``[N, T]``.
        steps: Gradient steps in each of 12 rounds.
        batch_size: States per step.
        learning_rate: Adam's step size.
        generator: Source of initial weights and batches.
    """
    observation = segments[OBSERVATION]
    flat = observation[:, :-1].flatten(0, 1)
    mean, std = flat.mean(0), flat.std(0).clamp(min=1e-2)
    ahead = utility[:, :-1].flip(1).cumsum(1).flip(1)
    scale = float(ahead.std().clamp(min=1e-6))
    with torch.random.fork_rng(devices=[]):
        # TorchRL initialises from the global generator only, so lend it a seed of ours.
        torch.default_generator.manual_seed(int(torch.randint(2**62, (), generator=generator)))
        network = MLP(flat.shape[1], 1, num_cells=list(_HIDDEN), activation_class=torch.nn.ReLU)
    value = Value(network, mean, std, scale)
    inputs, last = (flat - mean) / std, observation[:, -1]
    optimizer = adam(network.parameters(), lr=learning_rate)
    for done in range(_ROUNDS):
        # At first nothing is known of what comes after a segment.
        after = value(last) if done else torch.zeros(len(last))
        target = ((ahead + after.unsqueeze(1)) / scale).flatten()
        for _ in range(steps):
            row = torch.randint(len(flat), (batch_size,), generator=generator)
            # A choice of rows that lie together: several times as fast as ``inputs[row]``.
            seen, worth = inputs.index_select(0, row), target.index_select(0, row)
            loss = (network(seen).squeeze(-1) - worth).square().mean()
            take_step(optimizer, loss)
    return value


def with_values(
    groups: Sequence[RaterGroup], segments: TensorDictBase, *, generator: torch.Generator
) -> tuple[RaterGroup, ...]:
    """The same groups, comparing by regret with values fitted to segments ``[N, T]``.

    For environments without a transition table, from which ``make_groups`` takes exact advantages.
    """
    return tuple(
        replace(
            group,
            label="regret",
            advantages=None,
            value=fit_value(segments, group.step_utility(segments), generator=generator),
        )
        for group in groups
    )
