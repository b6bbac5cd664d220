"""What the policies do, and what that is worth to each hidden group."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.behaviours import first_action
from popl_rl.data.rollouts import MASK
from popl_rl.data.table_rollouts import Rollouts
from popl_rl.keys import ANSWER, INFO, OBSERVATION, PAIR, Answer
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.processes import Workers
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import PairPool
from popl_rl.raters.people import Raters

__all__ = [
    "episode_returns",
    "group_accuracy",
    "group_returns",
    "held_out_pairs",
    "info_rates",
    "mean_and_peak",
    "new_rater_answers",
    "recovery",
    "roll_out",
    "steps_to_success",
    "success_rate",
    "with_last_step_repeated",
]


def roll_out(
    make_env: Callable[[], gymnasium.Env[Any, Any]],
    policies: PolicySet | Tensor | None,
    *,
    episodes: int,
    max_steps: int,
    seed: int,
    greedy: bool = False,
    random_action: Callable[[TensorDictBase, torch.Generator], Tensor] | None = None,
    workers: Workers | None = None,
) -> TensorDict:
    """Roll every policy from the same starts, all in lockstep.

    Args:
        make_env: Builds one environment.
        policies: P policies, or tables ``[P, S, A]`` of action probabilities in each state
            (``("info", "next_state")``); None to roll ``random_action`` instead, as one policy.
        episodes: Episodes E per policy; episode e starts from the same seed for all policies.
        max_steps: Steps H after which an episode is cut.
        seed: Seed of the starts and of the sampled actions.
        greedy: Take the most likely actions instead of sampling.
        random_action: A behaviour to roll without policies.
        workers: Processes that step environments side by side, with the same result; this one if
            None.

    Returns:
        TensorDict ``[P, E, H]`` as from ``popl_rl.data.rollouts.lockstep``; discrete actions are
        those of the environment, which need not begin with 0.

    Raises:
        ValueError: If ``episodes`` or ``max_steps`` is not positive, or there is nothing to roll.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    if policies is None and random_action is None:
        raise ValueError("random_action must be given to roll without policies, got None")
    device = torch.device("cpu")
    if isinstance(policies, PolicySet):
        device = policies.population.device
    generator = torch.Generator(device).manual_seed(seed)
    starts = torch.randint(2**31, (episodes,), generator=generator, device=device).tolist()
    count = 1 if policies is None else len(policies)

    def act(step: TensorDictBase) -> Tensor:
        if isinstance(policies, Tensor):
            state = step[INFO, "next_state"].long().view(count, episodes)
            rows = policies[torch.arange(count).unsqueeze(1), state].flatten(0, 1)
            return first + torch.multinomial(rows, 1, generator=generator).squeeze(-1)
        if policies is not None:
            observation = step[OBSERVATION].view(count, episodes, -1).to(device)
            action = policies.act(observation, greedy=greedy, generator=generator)
            return moved + action.flatten(0, 1).cpu()
        assert random_action is not None
        return random_action(step, generator)

    roll = Rollouts(make_env, workers)
    first = first_action(roll.env.action_space)
    # Sets that were saved before their actions were the environment's count them from 0.
    spec = policies.population.spec if isinstance(policies, PolicySet) else None
    moved = first - spec.first_action if isinstance(spec, PolicySpec) else 0
    with roll:
        flat = roll(act, seeds=starts * count, max_steps=max_steps)
    return flat.unflatten(0, (count, episodes))


def group_returns(episodes: TensorDictBase, groups: Sequence[RaterGroup]) -> Tensor:
    """Mean undiscounted utility of an episode to each group.

    Args:
        episodes: ``[P, E, H]``. What stands after an episode's end is not shown to the groups,
            whose utilities may be undefined there.
        groups: G groups.

    Returns:
        ``[P, G]``.
    """
    return episode_returns(episodes, groups).mean(1)


def episode_returns(episodes: TensorDictBase, groups: Sequence[RaterGroup]) -> Tensor:
    """Undiscounted utility of each episode to each group, as ``group_returns``, ``[P, E, G]``."""
    flat = episodes.flatten(0, 1)
    mask = flat[MASK]
    shown = with_last_step_repeated(flat)
    returns = [torch.where(mask, group.step_utility(shown), 0).sum(1) for group in groups]
    return torch.stack(returns, -1).view(*episodes.shape[:2], -1)


def with_last_step_repeated(episodes: TensorDictBase) -> TensorDictBase:
    """Episodes ``[B, H]`` whose last real step stands in the place of what follows its end too."""
    mask = episodes[MASK]
    if bool(mask.all()):
        return episodes
    last = mask.sum(1, keepdim=True) - 1
    step = torch.arange(mask.shape[1]).minimum(last)
    return episodes[torch.arange(len(mask)).unsqueeze(1), step]


def info_rates(episodes: TensorDictBase, key: str) -> dict[int, Tensor]:
    """Share of episodes in which an integer info ever took each value, ``value -> [P]``.

    Empty without that key.
    """
    if (INFO, key) not in episodes.keys(include_nested=True):
        return {}
    value, mask = episodes[INFO, key], episodes[MASK]
    seen = value[mask].unique().tolist()
    return {int(v): ((value == v) & mask).any(-1).float().mean(-1) for v in seen}


def success_rate(episodes: TensorDictBase, key: str) -> Tensor:
    """Share of episodes in which info ``key`` was ever positive, ``[P]``; NaN without that key."""
    if (INFO, key) not in episodes.keys(include_nested=True):
        return torch.full(episodes.shape[:1], float("nan"))
    done: Tensor = (episodes[INFO, key] > 0) & episodes[MASK]
    return done.any(-1).float().mean(-1)


def steps_to_success(episodes: TensorDictBase, key: str) -> Tensor:
    """Steps until info ``key`` is positive, mean over the episodes in which it ever is, ``[P]``.

    NaN without that key, or where it never is.
    """
    if (INFO, key) not in episodes.keys(include_nested=True):
        return torch.full(episodes.shape[:1], float("nan"))
    done = (episodes[INFO, key] > 0) & episodes[MASK]
    steps = 1 + done.float().argmax(-1).float()
    reached = done.any(-1)
    mean: Tensor = (steps * reached).sum(-1) / reached.sum(-1)
    return mean


def mean_and_peak(episodes: TensorDictBase, key: str) -> tuple[Tensor, Tensor]:
    """Mean and greatest value of an info in an episode, each averaged over episodes, ``[P]``.

    NaN without that key.
    """
    if (INFO, key) not in episodes.keys(include_nested=True):
        unknown = torch.full(episodes.shape[:1], float("nan"))
        return unknown, unknown
    value, mask = episodes[INFO, key].float(), episodes[MASK]
    mean = (value * mask).sum(-1) / mask.sum(-1)
    peak = value.masked_fill(~mask, -torch.inf).amax(-1)
    return mean.mean(-1), peak.mean(-1)


def recovery(value: float, *, reference: float, oracle: float) -> float:
    """``(value - reference) / (oracle - reference)``: 1 is the oracle's return.

    0 is the return of what one can do without asking anybody: random actions, or a clone of what
    the data shows. NaN where the oracle is no better than that, since then nothing was there to
    recover.
    """
    return (value - reference) / (oracle - reference) if oracle > reference else float("nan")


def held_out_pairs(
    segment_utility: Tensor,
    group: int,
    *,
    count: int,
    pool: PairPool | None = None,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Fresh pairs on which a group has a strict opinion, and no rater's noise.

    Args:
        segment_utility: Worth of each stored segment to each group, ``[G, N]``.
        group: Which group.
        count: Pairs to draw; those of (nearly) equal worth are dropped.
        pool: What pairs are drawn from; all pairs of the N segments if None.
        generator: Source of the pairs.

    Returns:
        Preferred and other segments, each ``[count or fewer]``.
    """
    pool = PairPool(segment_utility.shape[1]) if pool is None else pool
    pair = pool.draw(count, generator=generator)
    first, second = segment_utility[group][pair].unbind(-1)
    strict = (first - second).abs() > 1e-6
    swap = (first < second)[strict]
    pair = pair[strict]
    pair = torch.where(swap.unsqueeze(-1), pair.flip(-1), pair)
    return pair[:, 0], pair[:, 1]


def group_accuracy(scores: Tensor, pairs: Mapping[int, tuple[Tensor, Tensor]]) -> Tensor:
    """Share of each group's strict pairs that each policy ranks right; a tie is not right.

    Args:
        scores: Segment scores, ``[P, N]``.
        pairs: Preferred and other segments of each group.

    Returns:
        ``[P, G]``.
    """
    right = [scores[:, better] > scores[:, worse] for better, worse in pairs.values()]
    return torch.stack([column.float().mean(1) for column in right], -1)


def new_rater_answers(
    groups: Sequence[RaterGroup],
    group: int,
    segment_utility: Tensor,
    *,
    answers: int,
    pool: PairPool | None = None,
    generator: torch.Generator,
) -> TensorDict:
    """Strict answers of a new rater of one group, noisy as that group's raters are.

    Args:
        groups: G groups.
        group: The new rater's group.
        segment_utility: ``[G, N]``.
        answers: Number of strict answers; ties and skips are asked again.
        pool: What pairs are drawn from; all pairs of the N segments if None.
        generator: Source of the pairs and of the rater's randomness.

    Returns:
        TensorDict ``[answers]`` with ``pair`` and ``answer``.

    Raises:
        ValueError: If the rater keeps answering ties and skips.
    """
    pool = PairPool(segment_utility.shape[1]) if pool is None else pool
    person = Raters(tuple(groups), torch.tensor([group]))
    pairs, replies, found = [], [], 0
    for _ in range(100):
        pair = pool.draw(answers, generator=generator)
        asked = torch.zeros(answers, dtype=torch.long)
        reply = person.answer(pair, asked, segment_utility, generator=generator)
        strict = reply <= Answer.SECOND
        pairs.append(pair[strict])
        replies.append(reply[strict])
        found += int(strict.sum())
        if found >= answers:
            data = {PAIR: torch.cat(pairs)[:answers], ANSWER: torch.cat(replies)[:answers]}
            return TensorDict(data, [answers])
    raise ValueError(
        f"a rater of group {groups[group].name!r} gave {found} strict answers to {100 * answers} "
        "queries, too few to cater to; lower the tie and skip thresholds"
    )
