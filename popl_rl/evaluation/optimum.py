"""Exact returns and the share of the optimum, where every transition, or every item, is known."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.tables import Table, expected_visits, policy_return
from popl_rl.evaluation.acting import Acting, Choosing, Rolling
from popl_rl.evaluation.measures import episode_returns, recovery
from popl_rl.keys import OBSERVATION
from popl_rl.models.policy_set import PolicySet
from popl_rl.raters.groups import RaterGroup

__all__ = [
    "ExactReturns",
    "Scale",
    "action_probabilities",
    "known_scale",
    "menu_returns",
    "menu_scale",
    "optimal_return",
]

_TOLERANCE = 1e-9


def action_probabilities(
    policies: PolicySet | Tensor | None, table: Table, *, greedy: bool = False
) -> Tensor:
    """Look up what policies do in every state of a table.

    Args:
        policies: P policies over discrete actions, or their tables ``[P, S, A]`` already; None for
            uniformly random actions, as one policy.
        table: S states and A actions.
        greedy: Whether policies take their most likely action instead of sampling one.

    Returns:
        Probabilities ``[P, S, A]`` on the CPU.
    """
    if policies is None:
        states, actions = table.next_state.shape
        return torch.full((1, states, actions), 1 / actions)
    if isinstance(policies, Tensor):
        return policies.cpu()
    # The last axis of steps is the action; what is observed before it does not depend on it.
    observation = table.steps[OBSERVATION][:, 0].to(policies.population.device)
    with torch.no_grad():
        output = policies.population(observation).cpu()
    if greedy:
        return F.one_hot(output.argmax(-1), output.shape[-1]).float()
    probabilities: Tensor = output.softmax(-1)
    return probabilities


def optimal_return(table: Table, utility: Tensor, *, horizon: int) -> float:
    """Highest expected undiscounted return of an episode, by backward induction in float64.

    Args:
        table: S states and A actions.
        utility: What each step is worth, ``[S, A]``.
        horizon: Steps after which an episode is cut off.
    """
    gain, goes_on = utility.double(), (~table.terminal).double()
    value = gain.new_zeros(len(gain))
    for _ in range(horizon):
        value = (gain + goes_on * value[table.next_state]).amax(1)
    start = table.start.double()
    return float(start @ value / start.sum())


class Scale:
    """What random actions and the best policy of each group are worth to it.

    Args:
        random: Return of uniformly random actions to each group, ``[G]`` float64.
        optimum: Highest possible return to each group, ``[G]`` float64.
    """

    def __init__(self, random: Tensor, optimum: Tensor) -> None:
        self.random, self.optimum = random, optimum

    def share_of_optimum(self, index: int, value: float) -> float:
        """``(value - random) / (optimum - random)`` of a return to the group of this index.

        NaN where a group likes nothing better than random actions.
        """
        low, high = float(self.random[index]), float(self.optimum[index])
        # The two are sums in different orders, which differ in the last digits where all is alike.
        if high - low <= _TOLERANCE * max(1.0, abs(high)):
            return float("nan")
        return recovery(value, reference=low, oracle=high)


def menu_scale(utility: Tensor, menus: Tensor) -> Scale:
    """The scale of choosing from menus: a random item of each, and the best item of each.

    Args:
        utility: What each of N items is worth to each group, ``[G, N]``.
        menus: Items on each of E menus, ``[E, K]``.
    """
    offered = utility.double()[:, menus]
    return Scale(offered.mean((1, 2)), offered.amax(2).mean(1))


def menu_returns(episodes: TensorDictBase, groups: Sequence[RaterGroup]) -> Tensor:
    """Exact returns of choosing from menus, each of which is an episode, ``[P, G]`` float64."""
    return episode_returns(episodes, groups).double().mean(1)


class ExactReturns(Scale):
    """Expected returns of policies to every group, without rollouts and their noise.

    The optimum may act by the number of steps left, so that no policy, whatever it knows, is above
    1. Groups must judge every step by itself, as their exact labels need anyway.

    Args:
        table: Every transition of the environment.
        groups: G groups.
        horizon: Steps after which an episode is cut off.
        greedy: Whether policies take their most likely action instead of sampling one.

    Attributes:
        optimum: Highest possible return to each group, ``[G]`` float64.
        random: Return of uniformly random actions to each group, ``[G]`` float64.
    """

    def __init__(
        self, table: Table, groups: Sequence[RaterGroup], *, horizon: int, greedy: bool = False
    ) -> None:
        self.table, self.horizon, self.greedy = table, horizon, greedy
        self.utilities = [group.step_utility(table.steps) for group in groups]
        optimum = [optimal_return(table, utility, horizon=horizon) for utility in self.utilities]
        super().__init__(self(None)[0], torch.tensor(optimum, dtype=torch.float64))

    def __call__(self, policies: PolicySet | Tensor | None) -> Tensor:
        """Exact returns to every group.

        Args:
            policies: See ``action_probabilities``.

        Returns:
            ``[P, G]`` float64.
        """
        tables = action_probabilities(policies, self.table, greedy=self.greedy)
        returns = [
            [
                policy_return(self.table, own, utility, horizon=self.horizon)
                for utility in self.utilities
            ]
            for own in tables
        ]
        return torch.tensor(returns, dtype=torch.float64)

    def of_greedy(self, policies: PolicySet | Tensor | None) -> Tensor:
        """Exact returns of always taking the most likely action, ``[P, G]`` float64.

        Args:
            policies: See ``action_probabilities``; tables and random actions stay as they are.
        """
        tables = action_probabilities(policies, self.table, greedy=True)
        visits = torch.stack(
            [expected_visits(self.table, own, horizon=self.horizon) for own in tables]
        )
        return visits.flatten(1) @ torch.stack(self.utilities).double().flatten(1).T


def known_scale(acting: Acting, groups: Sequence[RaterGroup]) -> Scale | None:
    """Tell the best there is where it is known.

    Args:
        acting: Where hypotheses act.
        groups: G groups.

    Returns:
        ``ExactReturns`` where every transition is known, ``menu_scale`` where items are chosen from
        menus, and None elsewhere.
    """
    if isinstance(acting, Choosing):
        utility = torch.stack([group.step_utility(acting.segments).sum(1) for group in groups])
        return menu_scale(utility, acting.menus)
    if isinstance(acting, Rolling) and acting.world.table is not None:
        table, greedy = acting.world.table, acting.greedy
        return ExactReturns(table, groups, horizon=acting.max_steps, greedy=greedy)
    return None
