"""From episodes to the pictures of how policies move, and to animations of them."""

from pathlib import Path
from typing import cast

import torch
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.accessories import accessory
from popl_rl.data.environments import World
from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.measures import mean_and_peak, steps_to_success
from popl_rl.evaluation.results import Scoreboard
from popl_rl.keys import INFO
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policy_set import PolicySet
from popl_rl.plotting.animation import record_gif
from popl_rl.plotting.motion_plots import plane, profiles

__all__ = ["animate", "draw_motion", "places_of", "profile"]

_MOST = 32  # policies that are rolled out for a picture


def profile(episodes: TensorDictBase, key: str) -> Tensor:
    """Mean of an info at each step over the episodes that have got there, ``[E, H] -> [H]``.

    NaN where fewer than half of the episodes are left: a few stragglers say little of the policy.
    """
    value, mask = episodes[INFO, key].float(), episodes[MASK]
    left = mask.sum(0)
    mean: Tensor = (value * mask).sum(0) / left
    return mean.masked_fill(2 * left < len(mask), torch.nan)


def draw_motion(
    found: HypothesisSet, *, board: Scoreboard, evaluator: Evaluator
) -> dict[str, Figure]:
    """Draw the plane of success and peaks, and profiles, of the first info that is measured.

    Returns:
        Nothing where the environment measures nothing.
    """
    if not evaluator.infos.measured or not isinstance(found, PolicySet):
        return {}
    measure = evaluator.infos.measured[0]
    names = [group.name for group in evaluator.groups]
    shown = found.subset(range(min(_MOST, len(found))))
    serves = evaluator.accuracy(shown).argmax(1).tolist()
    marks = {}
    curves = {}
    for name in names:
        curves[f"set, catered to {name}"] = profile(board.episodes[board.label, name][0], measure)
    for (method, name), episodes in board.episodes.items():
        if method == "oracle":
            marks[f"oracle of {name}"] = _place(episodes, evaluator)[0].tolist()
        elif method == "pooled_cpl":
            # One policy for everybody, whoever judges it.
            marks["pooled CPL"] = _place(episodes, evaluator)[0].tolist()
            curves["pooled CPL"] = profile(episodes[0], measure)
    places = places_of(found, len(shown), board, evaluator)
    return {
        "plane": plane(places.numpy(), serves, names, measure=measure, marks=marks),
        "profiles": profiles(curves, measure=measure),
    }


def places_of(found: PolicySet, count: int, board: Scoreboard, evaluator: Evaluator) -> Tensor:
    """Steps to success and mean peak of the first members of a set, ``[count, 2]``.

    Args:
        found: The set.
        count: How many.
        board: Episodes of the members that were rolled out for it are not rolled out again.
        evaluator: Rolls out the others.
    """
    done = {}
    if board.served is not None:
        places = _place(board.served.performance.episodes, evaluator)
        done = dict(zip(board.served.members, places, strict=True))
    new = [member for member in range(count) if member not in done]
    if new:
        places = _place(evaluator.acting(found.subset(new)), evaluator)
        done |= dict(zip(new, places, strict=True))
    return torch.stack([done[member] for member in range(count)])


def _place(episodes: TensorDictBase, evaluator: Evaluator) -> Tensor:
    """Steps to success and mean peak of what is measured, ``[P, 2]``."""
    steps = steps_to_success(episodes, evaluator.infos.success)
    return torch.stack([steps, mean_and_peak(episodes, evaluator.infos.measured[0])[1]], -1)


def animate(
    folder: Path, found: HypothesisSet, *, board: Scoreboard, world: World, seed: int
) -> dict[str, Path]:
    """Record an episode of the policy that each group is given, from one start for all.

    Args:
        folder: Folder of the files ``<group>.gif``.
        found: The set.
        board: Who was given what.
        world: Whose environment can be made with ``render_mode``.
        seed: Seed of the start.

    Returns:
        Name and file of each animation.

    Warns:
        UserWarning: If one cannot be recorded, as on a machine without a renderer.
    """
    policies = cast("PolicySet", found)
    env = world.make()
    env.unwrapped.render_mode = "rgb_array"
    paths = {}
    try:
        for name, member in board.catered.items():
            generator = torch.Generator().manual_seed(seed)

            def act(
                seen: Tensor, member: int = member, generator: torch.Generator = generator
            ) -> Tensor:
                return policies.act(seen, member=member, generator=generator).clone()

            path = folder / f"{name}.gif"
            with accessory(f"there is no animation for {name}", "see what render() needs"):
                # No longer than the episodes that were evaluated, where nothing else ends one.
                most = max(shown.shape[-1] for shown in board.episodes.values())
                record_gif(env, act, path, seed=seed, max_steps=most)
                paths[name] = path
    finally:
        env.close()
    return paths
