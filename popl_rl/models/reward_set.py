"""A set of reward functions."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.reward_functions import RewardSpec, reward_bank

__all__ = ["RewardSet"]


class RewardSet(HypothesisSet):
    """Reward functions of which every hidden group should find its own.

    Args:
        population: The reward functions.
        alpha: Scale of their scores, as trained.
        discount: Per-step discount of their scores.

    Attributes:
        origin: Member of the trained population that each one is; empty if it is none of them.
    """

    folder = "rewards"
    _kind = "reward"
    _spec = RewardSpec

    @staticmethod
    def _bank(segments: TensorDictBase) -> SegmentBank:
        return reward_bank(segments)

    @torch.no_grad()
    def reward(self, observation: Tensor) -> Tensor:
        """Rewards of every discrete action in every member's eyes.

        Args:
            observation: ``[B, O]``; with the action behind it if actions are continuous.

        Returns:
            ``[N, B, K]``, in each member's own units: only differences within a member mean
            something.
        """
        rewards: Tensor = self.population(observation)
        return rewards
