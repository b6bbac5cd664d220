"""What a group could get besides: of the data's behaviours, of others' models, of the optimum.

Rows ``behaviour`` (its name as the choice) of each behaviour of the data, ``data`` of all of them
in the shares of the data, ``best_behaviour`` of the one that is best for a group, ``ppo`` of a
policy that PPO has trained on the group's utility, and ``optimum``, where every transition is
known.
"""

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.algorithms.reward_baselines import RewardBaselines
from popl_rl.data.bank import SegmentBank
from popl_rl.evaluation.acting import Acting, Choosing, Rolling
from popl_rl.evaluation.measures import group_accuracy
from popl_rl.evaluation.optimum import Scale, menu_returns
from popl_rl.evaluation.results import Performance, Rows

__all__ = ["score_baselines", "score_behaviours", "score_distributional", "score_references"]


def score_references(
    rows: Rows, acting: Acting, *, ppo: Performance | None, exact: Scale | None
) -> None:
    """Add what G groups could get besides, without any set of policies.

    Args:
        rows: What is added to.
        acting: Where the data's behaviours act, see ``score_behaviours``.
        ppo: What policies do that PPO has trained on the utility of each group, ``[G, E, H]``; None
            for none.
        exact: Knows the optimum of each group; None where nobody does.
    """
    score_behaviours(rows, acting)
    if ppo is not None:
        for index in range(len(rows.groups)):
            rows.add(("ppo", ""), index, ppo.one(index), torch.ones(1))
    if exact is not None:
        _score_optimum(rows, exact)


def score_baselines(
    rows: Rows, base: Performance, accuracy: Tensor, *, pooled: str
) -> dict[tuple[str, str], TensorDict]:
    """Add the hypothesis that was trained on everybody's answers, and each group's oracle.

    Args:
        rows: What is added to.
        base: What the pooled one and, after it, the G oracles do.
        accuracy: Of each of these on each group's held-out pairs, ``[1 + G, G]``.
        pooled: Name of the pooled one.

    Returns:
        Episodes ``[1, E, H]`` behind pictures, by name and group.
    """
    one, episodes = torch.ones(1), {}
    for index, group in enumerate(rows.groups):
        for name, row in ((pooled, 0), ("oracle", 1 + index)):
            done, own = base.one(row), accuracy[row : row + 1, index]
            rows.add((name, ""), index, done, one)
            rows.add_accuracy((name, ""), index, catered=own, best=float(own))
            episodes[name, group.name] = done.episodes
    return episodes


def score_behaviours(rows: Rows, acting: Acting) -> None:
    """Add what the behaviours in the data are worth to each group, where there are several.

    Args:
        rows: What is added to.
        acting: Where behaviours act. Nothing is added where items are chosen, where an environment
            collects its data itself, or where all that the data show are random actions.
    """
    if not isinstance(acting, Rolling) or acting.world.collect is not None:
        return
    shares = {name: share for name, share in acting.world.shares.items() if share > 0}
    if set(shares) == {"random"}:
        return
    done = Performance(acting.behaviours(list(shares)), None)
    one, share = torch.ones(1), torch.tensor(list(shares.values()))
    returns = rows.returns(done.episodes)
    for index in range(len(rows.groups)):
        rows.add(("data", ""), index, done, share / share.sum())
        rows.add(("best_behaviour", ""), index, done.one(int(returns[:, index].argmax())), one)
        for place, name in enumerate(shares):
            rows.add(("behaviour", name), index, done.one(place), one)


def score_distributional(
    rows: Rows,
    rewards: RewardBaselines,
    acting: Acting,
    bank: SegmentBank,
    pairs: Mapping[int, tuple[Tensor, Tensor]],
) -> None:
    """Add what distributional models of rewards choose, where items are chosen.

    Args:
        rows: What is added to.
        rewards: The models.
        acting: A ``popl_rl.evaluation.acting.Choosing``.
        bank: Items.
        pairs: Preferred and other items of each group, for accuracies.
    """
    assert isinstance(acting, Choosing)
    for entry, score in rewards.scores(bank).items():
        episodes = acting.choose(score.cpu().unsqueeze(0))
        chosen = Performance(episodes, menu_returns(episodes, rows.groups))
        accuracy = group_accuracy(score.cpu().unsqueeze(0), pairs)
        for index in range(len(rows.groups)):
            rows.add(entry, index, chosen, torch.ones(1))
            own = accuracy[:, index]
            rows.add_accuracy(entry, index, catered=own, best=float(own))
    for kind, model in rewards.dpl.items():
        rows.add_whole((f"dpl_{kind}", ""), "hidden_context", model.hidden_context(bank))


def _score_optimum(rows: Rows, exact: Scale) -> None:
    """Add the return of the best policy of each group."""
    for index, value in enumerate(exact.optimum.tolist()):
        rows.add_return(("optimum", ""), index, value, error=0.0)
        rows.add_share(("optimum", ""), index, value)
