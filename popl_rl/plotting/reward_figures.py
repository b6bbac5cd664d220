"""The pictures of learnt reward functions over states on a line."""

import torch
from matplotlib.figure import Figure
from torch import Tensor

from popl_rl.algorithms.reward_baselines import RewardBaselines
from popl_rl.evaluation.acting import Choosing
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.results import Scoreboard
from popl_rl.keys import OBSERVATION
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.reward_set import RewardSet
from popl_rl.plotting.agreement_plots import agreement
from popl_rl.plotting.majority_plots import majority_figure
from popl_rl.plotting.utility_plots import Curves, utilities
from popl_rl.raters.condorcet import find_cycle, majority_preference

__all__ = ["draw_rewards"]

_STATES = 200  # points of a curve


def draw_rewards(
    rewards: HypothesisSet,
    baselines: HypothesisSet | None,
    *,
    board: Scoreboard,
    evaluator: Evaluator,
    reward_baselines: RewardBaselines | None,
) -> dict[str, Figure]:
    """Draw what was learnt of single states on a line, if that is what there was to learn.

    Args:
        rewards: What POPL found.
        baselines: One reward function for everybody, then the oracles.
        board: Whom each group's raters were given.
        evaluator: With the items, and what they are worth.
        reward_baselines: B-REX and DPL.

    Returns:
        Figures by name: ``utilities``, ``agreement`` and, with more than two groups,
        ``majority``. Empty where policies act, or a state has more than one coordinate.
    """
    if not isinstance(evaluator.acting, Choosing) or not isinstance(rewards, RewardSet):
        return {}
    items = evaluator.acting.segments.flatten(0, 1)
    if items[OBSERVATION].shape[-1] != 1:
        return {}
    order = items[OBSERVATION].squeeze(-1).argsort()
    items = items[order[torch.linspace(0, len(order) - 1, _STATES).round().long()]]
    states = items[OBSERVATION].squeeze(-1)
    segment_utility = torch.stack(
        [group.step_utility(items.unsqueeze(0)).squeeze(0) for group in evaluator.groups]
    )
    truths = {
        group.name: utility.numpy()
        for group, utility in zip(evaluator.groups, segment_utility, strict=True)
    }
    members = _curves(rewards, states)
    held_out = {
        f"POPL: a set of {len(rewards)}": Curves(
            members=members.numpy(),
            best={name: members[member].numpy() for name, member in board.catered.items()},
        )
    }
    if baselines is not None:
        line = _curves(baselines, states)[0]
        held_out["Bradley–Terry: one for all"] = Curves(line=line.numpy())
    if reward_baselines is not None:
        samples = _curves(reward_baselines.brex, states)
        held_out["B-REX: one posterior"] = Curves(
            members=samples.numpy(), line=samples.mean(0).numpy()
        )
        mean, std = reward_baselines.dpl["mean_variance"].step_mean_std(_placed(rewards, states))
        mean, std = mean.cpu(), std.cpu()
        held_out["DPL: mean and spread"] = Curves(
            line=mean.numpy(), band=((mean - std).numpy(), (mean + std).numpy())
        )
    picks = evaluator.cater(rewards, "posterior")
    chosen = {group.name: row.tolist() for group, row in zip(evaluator.groups, picks, strict=True)}
    figures = {
        "utilities": utilities(states.numpy(), truths, held_out),
        "agreement": agreement(states.numpy(), truths, members.numpy(), catered=chosen),
    }
    if len(evaluator.groups) > 2:
        preferred = majority_preference(segment_utility)
        figures["majority"] = majority_figure(
            states.numpy(), truths, preferred.numpy(), cycle=find_cycle(preferred)
        )
    return figures


def _placed(hypotheses: HypothesisSet, states: Tensor) -> Tensor:
    return states.unsqueeze(-1).to(hypotheses.population.device)


def _curves(rewards: HypothesisSet, states: Tensor) -> Tensor:
    assert isinstance(rewards, RewardSet)
    return rewards.reward(_placed(rewards, states)).squeeze(-1).cpu()
