"""A small problem to try methods on: answers of two groups about walks on the tiny environment."""

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase

from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.data.behaviours import random_behaviour
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.segments import collect_segments, segment_buffer
from popl_rl.keys import GROUP, HIDDEN, INFO, REWARD, UTILITY
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.raters.collector import collect_preferences
from popl_rl.raters.groups import make_groups
from popl_rl.raters.people import Raters
from popl_rl.testing.tiny import likes_left, likes_right, tiny_env

__all__ = ["poisoned", "tiny_data", "tiny_problem"]


def tiny_data(seed: int = 0) -> tuple[TensorDictBase, TensorDict]:
    """40 random walks of 4 steps on the tiny environment, and 15 answers of each of 8 raters.

    Half of the raters want to be on the left, half on the right.

    Returns:
        Segments ``[40, 4]`` and preferences ``[120]``, with the hidden keys.
    """
    generator = torch.Generator().manual_seed(seed)
    segments = collect_segments(
        lambda: tiny_env(max_steps=8),
        {"random": random_behaviour(tiny_env().action_space)},
        num_segments=40,
        length=4,
        generator=generator,
        num_envs=8,
    )
    raters = Raters(
        make_groups([likes_left, likes_right], label="return"), torch.tensor([0] * 4 + [1] * 4)
    )
    buffer = collect_preferences(
        segment_buffer(segments), raters, answers_per_rater=15, generator=generator
    )
    return segments, buffer[:].exclude("index")


def poisoned(
    segments: TensorDictBase, preferences: TensorDict, *, how: Literal["garbage", "absent"]
) -> tuple[TensorDictBase, TensorDict]:
    """The same data with everything that no learner may read made useless.

    Args:
        segments: ``[N, T]``.
        preferences: ``[M]`` with the hidden keys.
        how: ``"garbage"``: groups that there are not, utilities and rewards that are no numbers.
            ``"absent"``: without hidden keys, rewards and infos.
    """
    segments, preferences = segments.clone(), preferences.clone()
    if how == "absent":
        return segments.exclude(REWARD, INFO), preferences.exclude(HIDDEN)
    preferences[GROUP] = torch.full_like(preferences[GROUP], -(2**62))
    preferences[UTILITY] = torch.full_like(preferences[UTILITY], torch.nan)
    segments[REWARD] = torch.full_like(segments[REWARD], torch.nan)
    for name in list(segments[INFO].keys()):
        segments[INFO, name] = torch.full_like(segments[INFO, name], -(2**62))
    return segments, preferences


def tiny_problem(
    segments: TensorDictBase,
    preferences: TensorDictBase,
    *,
    cases: Literal["rater", "preference"] = "rater",
    evolve: Literal["all", "head"] = "all",
    learns: Literal["policy", "reward"] = "policy",
) -> Problem:
    """What a method is given: three generations of four small members.

    Args:
        segments: ``[N, T]``.
        preferences: ``[M]``.
        cases: What lexicase filters on.
        evolve: Whole networks, or last layers on a shared trunk.
        learns: Policies or reward functions.
    """
    spec = RewardSpec(5, 2, (6,)) if learns == "reward" else PolicySpec(5, 2, True, (6,))
    return Problem(
        spec,
        spec.bank(segments),
        Comparisons.from_preferences(preferences, cases=cases),
        Training(steps=6, batch_size=16),
        evolve=evolve,
        members=4,
        generations=3,
    )
