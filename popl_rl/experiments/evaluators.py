"""The evaluator that fits what is learnt, and where."""

import torch

from popl_rl.config import Config
from popl_rl.data.environments import World, indexed, is_stateless
from popl_rl.evaluation.acting import Acting, Choosing, Optimising, Planning, Rolling
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.experiments.data import Data, fresh_segments
from popl_rl.keys import PAIR
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import held_out_pool

__all__ = ["make_evaluator"]


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
    """The judge that fits what is learnt and where.

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

    Raises:
        ValueError: If planning is asked for without a transition table.
    """
    device, options = config.device, config.evaluation
    if is_stateless(world.env):
        segments = fresh_segments(config.data, world, seed=seed, env=config.env)
        bank = spec.bank(indexed(segments, world.env.action_space)).to(device)
        segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
        chooser = Choosing(segments, bank, options, seed=seed)
        return Evaluator(
            chooser,
            config.env,
            options,
            groups,
            bank,
            segment_utility,
            shares=config.raters.shares,
            seed=seed,
        )
    bank = spec.bank(indexed(data.steps, world.env.action_space)).to(device)
    acting: Acting = Rolling(world, config.env, options, seed=seed)
    if isinstance(spec, RewardSpec):
        can_plan = world.table is not None and options.optimiser != "ppo"
        if can_plan or options.optimiser == "plan":
            acting = Planning(world, config.env, options, seed=seed)
        else:
            acting = Optimising(world, config.env, options, seed=seed, bank=bank)
    return Evaluator(
        acting,
        config.env,
        options,
        groups,
        bank,
        data.segment_utility,
        pool=held_out_pool(data.steps, data.preferences[PAIR]),
        clone=clone,
        shares=config.raters.shares,
        seed=seed,
    )
