"""What learnt reward functions are compared with: B-REX and DPL, on the same comparisons."""

from dataclasses import dataclass

import torch
from torch import Tensor

from popl_rl.algorithms.brex import brex
from popl_rl.algorithms.dpl import DistributionalReward, train_dpl
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import build_network
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.reward_set import RewardSet

__all__ = ["RewardBaselines", "brex_set", "segment_features", "train_reward_baselines"]

_UNITS = 512  # random features, as published with POPL
#: Quantile of a risk-averse choice: 0.01 as in DPL; atoms are too coarse for it.
_RISK = {"mean_variance": 0.01, "categorical": 0.1}


@dataclass(frozen=True)
class RewardBaselines:
    """Reward learners that know nothing of groups.

    Attributes:
        brex: Samples of B-REX's posterior.
        dpl: Distributional rewards, by kind.
    """

    brex: RewardSet
    dpl: dict[str, DistributionalReward]

    def scores(self, bank: SegmentBank) -> dict[tuple[str, str], Tensor]:
        """Scores ``[N]`` of DPL's kinds, by name of the method and what a choice goes by."""
        return {
            (f"dpl_{kind}", choice): model.scores(bank, risk=risk)
            for kind, model in self.dpl.items()
            for choice, risk in (("expectation", None), ("risk_averse", _RISK[kind]))
        }


def segment_features(trunk: torch.nn.Module, bank: SegmentBank, action_dim: int) -> Tensor:
    """Features that a linear head on ``trunk`` sums over a segment, ``[N, action_dim * F]``."""
    features = trunk(bank.observation)
    size, width = len(bank), features.shape[-1]
    total = torch.zeros(size * action_dim, width, device=features.device)
    segment = torch.arange(size, device=features.device).unsqueeze(1)
    target = (segment * action_dim + bank.action).flatten()
    values = features[bank.row.flatten()]
    if bank.mask is not None:
        values = values * bank.mask.flatten().unsqueeze(1)
    total.index_add_(0, target, values)
    return total.view(size, -1)


@torch.no_grad()
def brex_set(
    spec: RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    steps: int = 10_000,
    keep: int = 1000,
    generator: torch.Generator,
) -> RewardSet:
    """Samples of B-REX's posterior (``popl_rl.algorithms.brex.brex``), as a set to cater from.

    Args:
        spec: Sizes of the reward functions; its hidden layers are replaced by one of 512 frozen
            random units, on which heads are linear.
        bank: Segments.
        comparisons: M strict preferences.
        steps: Steps of the chain; the first tenth is burnt in.
        keep: Samples to keep, at most 9 in 10 of the steps.
        generator: Source of features and chain.
    """
    spec = RewardSpec(spec.observation_dim, spec.action_dim, (_UNITS,))
    network = build_network(spec, generator=generator).to(bank.row.device)
    features = segment_features(network[:-1], bank, spec.action_dim)
    burn_in = steps // 10
    pairs = comparisons.preferred, comparisons.other
    many = len(comparisons) > len(bank)
    chain = brex(
        features if many else features[pairs[0]] - features[pairs[1]],
        pairs=pairs if many else None,
        steps=steps,
        burn_in=burn_in,
        keep=min(keep, steps - burn_in),
        generator=generator,
    )
    single = Population([network], spec, evolve="head")
    heads = single.members.data.expand(len(chain), *single.members.shape[1:]).clone()
    heads["0", "weight"] = chain.weights.view(len(chain), spec.action_dim, _UNITS)
    return RewardSet(single.with_members(heads), alpha=1.0)


def train_reward_baselines(
    spec: RewardSpec,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    brex_steps: int = 10_000,
    dpl_steps: int = 500,
    learning_rate: float = 1e-2,
    generator: torch.Generator,
) -> RewardBaselines:
    """Train B-REX and both kinds of DPL.

    Args:
        spec: Sizes of the reward functions.
        bank: Segments.
        comparisons: M strict preferences.
        brex_steps: Steps of B-REX's chain.
        dpl_steps: Gradient steps of each DPL model.
        learning_rate: Step size of their Adam.
        generator: Source of all randomness.
    """
    chain = brex_set(spec, bank, comparisons, steps=brex_steps, generator=generator)
    dpl = {}
    for kind in ("mean_variance", "categorical"):
        dpl[kind] = train_dpl(
            bank,
            comparisons,
            kind=kind,  # type: ignore[arg-type]
            hidden=spec.hidden,
            steps=dpl_steps,
            learning_rate=learning_rate,
            generator=generator,
        )
    return RewardBaselines(chain, dpl)
