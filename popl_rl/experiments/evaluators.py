"""The evaluator that fits what is learnt, and where."""

import warnings
from typing import Any, cast

import torch

from popl_rl.config import Config, EvaluationConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.environments import World, indexed, is_stateless
from popl_rl.evaluation.acting import Acting, Choosing, Optimising, Planning, Rolling
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.protocol import EvaluationProtocol, MeasuredInfos
from popl_rl.experiments.data import Data, fresh_segments
from popl_rl.keys import PAIR
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import held_out_pool

__all__ = ["build_protocol", "make_evaluator"]


def make_evaluator(
    config: Config,
    world: World,
    groups: tuple[RaterGroup, ...],
    data: Data,
    spec: PolicySpec | RewardSpec,
    *,
    clone: HypothesisSet | None = None,
    seed: int,
) -> Evaluator:
    """The evaluator that fits what is learnt and where.

    Policies are rolled out. Reward functions are planned for or optimised by PPO, and rolled out;
    where there is nothing to do they choose from menus of fresh segments.

    Args:
        config: The run's configuration.
        world: Where policies act.
        groups: G groups.
        data: Segments, and their worth.
        spec: Sizes of the hypotheses.
        clone: A clone of the data's typical behaviour, for comparison; None for none.
        seed: Seed of the evaluation.

    Warns:
        UserWarning: If there are fewer held-out pairs than ``evaluation.pairs`` asks for.

    Raises:
        ValueError: If planning is asked for without a transition table.
    """
    device, options = config.device, config.evaluation
    infos = MeasuredInfos(config.env.success, config.env.door, tuple(config.env.measured))
    common: dict[str, Any] = {
        "protocol": build_protocol(options),
        "infos": infos,
        "shares": config.raters.shares,
        "seed": seed,
    }
    if is_stateless(world.env):
        segments = fresh_segments(config.data, world, seed=seed, env=config.env)
        bank = spec.bank(indexed(segments, world.env.action_space)).to(device)
        segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
        chooser = Choosing(segments, bank, menus=options.episodes, items=options.menu, seed=seed)
        return Evaluator(chooser, groups, bank, segment_utility, **common)
    bank = spec.bank(indexed(data.steps, world.env.action_space)).to(device)
    pool = held_out_pool(data.steps, data.preferences[PAIR])
    if pool.num_pairs < options.pairs:
        warnings.warn(
            f"evaluation.pairs asks for {options.pairs} held-out pairs, but the data have "
            f"{pool.num_pairs}: pairs repeat, and accuracies are as precise as those of "
            f"{pool.num_pairs}; set evaluation.pairs={pool.num_pairs} or collect more segments "
            "(data.segments)",
            stacklevel=2,
        )
    return Evaluator(
        _acting(config, world, spec, bank, seed=seed),
        groups,
        bank,
        data.segment_utility,
        pool=pool,
        clone=clone,
        **common,
    )


def build_protocol(config: EvaluationConfig) -> EvaluationProtocol:
    """How many answers, raters and pairs an evaluation takes, from the settings."""
    return EvaluationProtocol(
        answers=config.answers,
        new_raters=config.new_raters,
        curve=tuple(config.curve),
        curve_members=config.curve_members,
        pairs=config.pairs,
        reference=cast("Any", config.reference),
    )


def _acting(
    config: Config, world: World, spec: PolicySpec | RewardSpec, bank: SegmentBank, *, seed: int
) -> Acting:
    """What shows what hypotheses of a kind do, where there is something to do."""
    options = config.evaluation
    how: dict[str, Any] = {
        "episodes": options.episodes,
        "max_steps": config.env.max_steps,
        "greedy": options.greedy,
        "seed": seed,
    }
    if not isinstance(spec, RewardSpec):
        return Rolling(world, **how)
    can_plan = world.table is not None and options.optimiser != "ppo"
    if can_plan or options.optimiser == "plan":
        return Planning(world, **how)
    return Optimising(world, frames=options.ppo_frames, bank=bank, **how)
