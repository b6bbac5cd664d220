"""The pictures of learnt reward functions over states on a line."""

import torch
from matplotlib.figure import Figure
from torch import Tensor

from popl_rl.acting import Choosing
from popl_rl.keys import OBSERVATION
from popl_rl.majority import find_cycle, majority
from popl_rl.policy_set import HypothesisSet, RewardSet
from popl_rl.results import Judge
from popl_rl.reward_baselines import Rivals
from popl_rl.scoreboard import Scoreboard
from popl_rl.utility_plots import Curves, agreement, majority_figure, utilities

__all__ = ["draw_rewards"]

_STATES = 200  # points of a curve


def draw_rewards(
    rewards: HypothesisSet,
    baselines: HypothesisSet | None,
    *,
    board: Scoreboard,
    judge: Judge,
    rivals: Rivals | None,
) -> dict[str, Figure]:
    """Draw what was learnt of single states on a line, if that is what there was to learn.

    Args:
        rewards: What POPL found.
        baselines: One reward function for everybody, then the oracles.
        board: Whom each group's raters were given.
        judge: With the items, and what they are worth.
        rivals: B-REX and DPL.

    Returns:
        Figures by name: ``utilities``, ``agreement`` and, with more than two groups, ``majority``.
        Empty where policies act, or a state has more than one coordinate.
    """
    if not isinstance(judge.acting, Choosing) or not isinstance(rewards, RewardSet):
        return {}
    items = judge.acting.segments.flatten(0, 1)
    if items[OBSERVATION].shape[-1] != 1:
        return {}
    order = items[OBSERVATION].squeeze(-1).argsort()
    items = items[order[torch.linspace(0, len(order) - 1, _STATES).round().long()]]
    states = items[OBSERVATION].squeeze(-1)
    worth = torch.stack(
        [group.step_utility(items.unsqueeze(0)).squeeze(0) for group in judge.groups]
    )
    truths = {
        group.name: utility.numpy() for group, utility in zip(judge.groups, worth, strict=True)
    }
    members = _curves(rewards, states)
    panels = {
        f"POPL: a set of {len(rewards)}": Curves(
            members=members.numpy(),
            best={name: members[member].numpy() for name, member in board.catered.items()},
        )
    }
    if baselines is not None:
        line = _curves(baselines, states)[0]
        panels["Bradley–Terry: one for all"] = Curves(line=line.numpy())
    if rivals is not None:
        samples = _curves(rivals.brex, states)
        panels["B-REX: one posterior"] = Curves(
            members=samples.numpy(), line=samples.mean(0).numpy()
        )
        mean, std = rivals.dpl["mean_variance"].step_mean_std(_placed(rewards, states))
        mean, std = mean.cpu(), std.cpu()
        panels["DPL: mean and spread"] = Curves(
            line=mean.numpy(), band=((mean - std).numpy(), (mean + std).numpy())
        )
    picks = judge.cater(rewards, "posterior")
    chosen = {group.name: row.tolist() for group, row in zip(judge.groups, picks, strict=True)}
    figures = {
        "utilities": utilities(states.numpy(), truths, panels),
        "agreement": agreement(states.numpy(), truths, members.numpy(), catered=chosen),
    }
    if len(judge.groups) > 2:
        preferred = majority(worth)
        figures["majority"] = majority_figure(
            states.numpy(), truths, preferred.numpy(), cycle=find_cycle(preferred)
        )
    return figures


def _placed(hypotheses: HypothesisSet, states: Tensor) -> Tensor:
    return states.unsqueeze(-1).to(hypotheses.population.device)


def _curves(rewards: HypothesisSet, states: Tensor) -> Tensor:
    assert isinstance(rewards, RewardSet)
    return rewards.reward(_placed(rewards, states)).squeeze(-1).cpu()
