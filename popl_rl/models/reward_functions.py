"""Reward functions as hypotheses: what a network of one is, and the segments it reads."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.keys import ACTION, MASK, OBSERVATION
from popl_rl.models.policies import PolicySpec

__all__ = ["RewardSpec", "reward_bank"]


@dataclass(frozen=True)
class RewardSpec:
    """Everything needed to rebuild a reward network.

    A reward network has one output for each discrete action, the reward of taking it. There is no
    bias in the last layer: among segments of equal lengths a constant reward cancels in every
    comparison.

    Attributes:
        observation_dim: Length O of what the network reads: an observation, with the action behind
            it if actions are continuous (see ``reward_bank``).
        action_dim: Number K of outputs: one for each discrete action, or 1.
        hidden: Units of each hidden layer. Empty for a linear reward.
    """

    observation_dim: int
    action_dim: int = 1
    hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        for name in ("observation_dim", "action_dim"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if any(units < 1 for units in self.hidden):
            raise ValueError(f"hidden must hold layer widths of at least 1, got {self.hidden}")

    @classmethod
    def from_env(
        cls, env: gymnasium.Env[Any, Any], *, hidden: Sequence[int] = (64, 64)
    ) -> "RewardSpec":
        """Read the sizes off a Gymnasium environment's spaces.

        Raises:
            TypeError: If observations are not a flat ``Box`` or actions neither ``Discrete`` nor a
                flat ``Box``.
        """
        sizes = PolicySpec.from_env(env, hidden=hidden)
        if sizes.discrete:
            return cls(sizes.observation_dim, sizes.action_dim, sizes.hidden)
        return cls(sizes.observation_dim + sizes.action_dim, 1, sizes.hidden)

    @property
    def discrete(self) -> bool:
        """A step picks one of the outputs."""
        return True

    @property
    def refines(self) -> bool:
        """Whether POPL's last training has been tried for this kind of hypotheses."""
        return False

    @property
    def output_bias(self) -> bool:
        """There is none, see above."""
        return False

    def table(self, output: Tensor) -> Tensor:
        """Rewards are scores as they are."""
        return output

    def step_scores(self, output: Tensor, action: Tensor) -> Tensor:
        """Rewards of the actions taken.

        Args:
            output: ``[..., K]``.
            action: ``[...]`` int64, broadcast to ``output``.

        Returns:
            ``[...]``.
        """
        chosen = action.expand(output.shape[:-1]).unsqueeze(-1)
        return output.gather(-1, chosen).squeeze(-1)

    def conservatism(self, value: float) -> float:  # noqa: ARG002
        """Always 1: of reward functions only differences mean something."""
        return 1.0

    def cloning(self, value: float) -> float:  # noqa: ARG002
        """Always 0: a reward is no likelihood of what was done."""
        return 0.0

    def bank(self, segments: TensorDictBase) -> SegmentBank:
        """See ``reward_bank``."""
        return reward_bank(segments)


def reward_bank(segments: TensorDictBase) -> SegmentBank:
    """Index segments ``[N, T]`` for reward functions.

    Continuous actions ``[N, T, A]`` are joined to the observations, so that the reward depends on
    both, ``[U, O + A]``; discrete ones choose an output.
    """
    action = segments[ACTION]
    if not action.is_floating_point():
        return SegmentBank.from_segments(segments)
    joined = segments.select(OBSERVATION, MASK, strict=False).copy()
    joined[OBSERVATION] = torch.cat([segments[OBSERVATION], action], -1)
    joined[ACTION] = torch.zeros(action.shape[:2], dtype=torch.long, device=action.device)
    return SegmentBank.from_segments(joined)
