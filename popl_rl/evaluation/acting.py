"""From hypotheses to what they do: roll policies, plan for reward functions, or choose items."""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from tensordict import TensorDict, TensorDictBase, pad
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.data.behaviours import Behaviour, random_behaviour
from popl_rl.data.environments import World, counting_from_zero
from popl_rl.data.rollouts import MASK
from popl_rl.data.tables import Table, solve
from popl_rl.evaluation.measures import roll_out
from popl_rl.evaluation.ppo import reward_of, train_ppo
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.reward_set import RewardSet
from popl_rl.models.scoring import segment_scores
from popl_rl.randomness import stream

__all__ = ["Acting", "Choosing", "Optimising", "Planning", "Rolling", "plan"]

_HIDDEN = (64, 64)  # units of the policies that PPO trains


class Acting(Protocol):
    """Shows what hypotheses do."""

    def __call__(self, hypotheses: HypothesisSet | None) -> TensorDict:
        """Episodes ``[P, E, H]`` of every hypothesis; of random actions, ``[1, E, H]``, if None."""
        ...


class Rolling:
    """Policies act for themselves.

    Args:
        world: Where to roll out.
        episodes: Episodes of each policy.
        max_steps: Steps after which an episode is cut.
        greedy: Whether to take the most likely actions instead of sampled ones.
        seed: Seed of starts and actions.
    """

    def __init__(
        self, world: World, *, episodes: int, max_steps: int, greedy: bool = False, seed: int
    ) -> None:
        self.world, self.episodes, self.max_steps = world, episodes, max_steps
        self.greedy, self.seed = greedy, seed

    def __call__(self, hypotheses: HypothesisSet | None) -> TensorDict:
        """See ``Acting``."""
        return self._roll(self.policies(hypotheses))

    def behaviours(self, names: Sequence[str]) -> TensorDict:
        """Episodes ``[P, E, H]`` of P of the data's behaviours, where policies act."""
        rolled = []
        for name in names:
            behaviour = self.world.behaviours[name]
            if hasattr(behaviour, "reset"):
                behaviour.reset()
            rolled.append(self._roll(None, behaviour))
        longest = max(episodes.shape[-1] for episodes in rolled)
        return torch.cat([_padded(episodes, longest) for episodes in rolled])  # type: ignore[call-overload,no-any-return]

    def policies(self, hypotheses: HypothesisSet | None) -> PolicySet | Tensor | None:
        """The policies by which hypotheses act.

        Args:
            hypotheses: P hypotheses; None for random actions.

        Returns:
            P policies, or tables ``[P, S, A]`` of action probabilities; None for random actions.

        Raises:
            TypeError: If the hypotheses do not act for themselves.
        """
        if hypotheses is not None and not isinstance(hypotheses, PolicySet):
            raise TypeError(
                f"hypotheses must be a PolicySet, got a {type(hypotheses).__name__}; reward "
                "functions act by planning or after PPO"
            )
        return hypotheses

    def _roll(
        self, policies: PolicySet | Tensor | None, behaviour: Behaviour | None = None
    ) -> TensorDict:
        return roll_out(
            self.world.make,
            policies,
            episodes=self.episodes,
            max_steps=self.max_steps,
            seed=self.seed,
            greedy=self.greedy,
            workers=self.world.workers,
            random_action=behaviour
            or random_behaviour(self.world.env.action_space, unbounded=True),
        )


class Planning(Rolling):
    """Reward functions act by the exactly optimal policy of their rewards.

    Needs an environment with a transition table.
    """

    def policies(self, hypotheses: HypothesisSet | None) -> PolicySet | Tensor | None:
        """See ``Rolling.policies``."""
        if not isinstance(hypotheses, RewardSet):
            return super().policies(hypotheses)
        if self.world.table is None:
            raise ValueError(
                "the environment exposes no transition table to plan with; set "
                "evaluation.optimiser=ppo"
            )
        return plan(hypotheses, self.world.table)


class Optimising(Rolling):
    """Reward functions act by policies that PPO trains on them, once each.

    Args:
        world: Where to train and roll out.
        episodes: Episodes of each policy.
        max_steps: Steps after which an episode is cut.
        greedy: Whether to take the most likely actions instead of sampled ones.
        seed: Seed of everything random.
        frames: Frames of PPO for each reward function.
        bank: Segments, of whose steps the best is worth 0, as in ``plan``.
        progress: Called with the number of policies trained so far.
    """

    def __init__(
        self,
        world: World,
        *,
        episodes: int,
        max_steps: int,
        greedy: bool = False,
        seed: int,
        frames: int,
        bank: SegmentBank,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        super().__init__(world, episodes=episodes, max_steps=max_steps, greedy=greedy, seed=seed)
        self.frames, self.bank = frames, bank
        self.progress = progress
        self._trained: dict[bytes, Population] = {}

    def policies(self, hypotheses: HypothesisSet | None) -> PolicySet | Tensor | None:
        """See ``Rolling.policies``."""
        if not isinstance(hypotheses, RewardSet):
            return super().policies(hypotheses)
        trained = [self._policy(hypotheses, member) for member in range(len(hypotheses))]
        networks = [population.network(0) for population in trained]
        return PolicySet(Population(networks, PolicySpec.from_env(self.world.env, hidden=_HIDDEN)))

    def _policy(self, rewards: RewardSet, member: int) -> Population:
        own = rewards.population.members.data[member].values(True, True)
        key = b"".join(value.cpu().numpy().tobytes() for value in own)
        if key not in self._trained:
            # PPO's policies choose actions as reward functions judge them: counted from 0.
            spec = PolicySpec.from_env(counting_from_zero(self.world.env), hidden=_HIDDEN)
            best = rewards.subset([member]).reward(self.bank.observation).max()
            reward = reward_of(rewards, member)
            self._trained[key] = train_ppo(
                lambda: counting_from_zero(self.world.make()),
                lambda steps: reward(steps) - best,
                spec,
                frames=self.frames,
                max_steps=self.max_steps,
                generator=stream(self.seed, "ppo"),
            )
            if self.progress is not None:
                self.progress(len(self._trained))
        return self._trained[key]


class Choosing:
    """Hypotheses choose items from menus: what is left to do where actions change nothing.

    An item is a segment; a menu is a few of them. The one with the highest score is chosen, and
    counts as an episode.

    Args:
        segments: Items ``[N, T]``.
        bank: The same items, as hypotheses read them.
        menus: Menus E to choose from.
        items: Items on each of them.
        seed: Seed of the menus.
    """

    def __init__(
        self, segments: TensorDictBase, bank: SegmentBank, *, menus: int, items: int, seed: int
    ) -> None:
        self.segments, self.bank = segments, bank
        self.menus = torch.randint(len(bank), (menus, items), generator=stream(seed, "menus"))

    def __call__(self, hypotheses: HypothesisSet | None) -> TensorDict:
        """See ``Acting``; random choice takes each menu's first item."""
        if hypotheses is None:
            return self._episodes(self.menus[:, 0].unsqueeze(0))
        scores = segment_scores(
            hypotheses.population, self.bank, alpha=hypotheses.alpha, discount=hypotheses.discount
        )
        return self.choose(scores.cpu())

    def choose(self, scores: Tensor) -> TensorDict:
        """Episodes ``[P, E, T]`` of choosers with these scores of all items, ``[P, N]``."""
        best = scores[:, self.menus].argmax(-1, keepdim=True)
        return self._episodes(self.menus.expand(len(scores), -1, -1).gather(-1, best).squeeze(-1))

    def _episodes(self, chosen: Tensor) -> TensorDict:
        episodes: TensorDict = self.segments[chosen]
        return episodes.set(MASK, torch.ones(episodes.shape, dtype=torch.bool))


def _padded(episodes: TensorDict, length: int) -> TensorDict:
    """Episodes ``[P, E, H]`` with steps that nobody took up to a length."""
    return pad(episodes, [0, 0, 0, 0, 0, length - episodes.shape[-1]])


def plan(rewards: RewardSet, table: Table, *, discount: float = 0.97) -> Tensor:
    """Optimal policies of reward functions, by value iteration.

    Comparisons of equally long segments say nothing of a constant added to every step, but it
    decides whether going on pays. It is fixed such that the best of all steps is worth 0 and time
    costs something anywhere else.

    Args:
        rewards: P reward functions over discrete actions.
        table: Exact model of S states and A actions.
        discount: Discount of the optimal policies, that of the raters' regret.

    Returns:
        Action probabilities ``[P, S, A]``: one for the best action (the first of equals).
    """
    # The last axis of steps is the action; what is observed does not depend on it.
    seen = rewards.reward(table.steps["observation"][:, 0].to(rewards.population.device)).cpu()
    policies = []
    for member in seen:
        cost = member.double() - float(member.max())
        advantages, _ = solve(table, cost, discount=discount)
        policies.append(F.one_hot(advantages.argmax(-1), member.shape[-1]).float())
    return torch.stack(policies)
