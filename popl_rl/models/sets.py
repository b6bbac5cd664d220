"""Sets of whichever kind: made from a population, read from a folder."""

from pathlib import Path

from popl_rl.models.encoded_policy_set import EncodedPolicySet, EncodedRewardSet
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.reward_set import RewardSet

__all__ = ["as_set", "load_set"]


def as_set(population: Population, *, alpha: float, discount: float = 1.0) -> HypothesisSet:
    """A ``PolicySet`` of policies, or a ``RewardSet`` of reward functions."""
    kind = PolicySet if isinstance(population.spec, PolicySpec) else RewardSet
    return kind(population, alpha=alpha, discount=discount)


def load_set(path: Path | str) -> HypothesisSet:
    """Read a set of whichever kind is at ``path``.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is truncated, damaged, or something else.
    """
    kinds: tuple[type[HypothesisSet], ...] = (RewardSet, EncodedRewardSet, EncodedPolicySet)
    kind = next((kind for kind in kinds if kind.is_at(path)), PolicySet)
    return kind.load(path)
