"""The pictures of a run, drawn from its files and its scoreboard."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tensordict import TensorDictBase

from popl_rl.accessories import accessory
from popl_rl.algorithms.reward_baselines import RewardBaselines
from popl_rl.data.environments import World, offered
from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.method_names import method_name
from popl_rl.evaluation.results import Scoreboard
from popl_rl.evaluation.statistics import headline_measure
from popl_rl.keys import INFO
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.plotting import run_plots as plots
from popl_rl.plotting.member_plots import members
from popl_rl.plotting.motion_figures import animate, draw_motion
from popl_rl.plotting.recovery_plots import recovery_bars
from popl_rl.plotting.reward_figures import draw_rewards
from popl_rl.plotting.style import save

__all__ = ["draw", "occupancy_map"]

#: What a recovery of 0 is, by ``evaluation.reference``.
_FLOORS = {
    "random": "random actions",
    "clone": "a clone of the data",
    "others": "what suits\nanother group",
}


def occupancy_map(episodes: TensorDictBase, cells: torch.Tensor) -> NDArray[np.float64]:
    """Share of steps spent in each cell of a grid.

    Args:
        episodes: With ``("info", "state")``, ``[..., H]``.
        cells: Column and row of every state, ``[S, 2]``.

    Returns:
        ``[rows, columns]``, summing to 1.
    """
    state = episodes[INFO, "state"][episodes[MASK]].long()
    column, row = cells[state].unbind(-1)
    counts = torch.zeros(int(cells[:, 1].max()) + 2, int(cells[:, 0].max()) + 2)
    counts.index_put_((row, column), torch.ones(len(state)), accumulate=True)
    share: NDArray[np.float64] = (counts / counts.sum()).double().numpy()
    return share


def draw(
    run_dir: Path,
    found: HypothesisSet,
    baselines: HypothesisSet | None,
    *,
    board: Scoreboard,
    evaluator: Evaluator,
    world: World,
    reward_baselines: RewardBaselines | None = None,
    with_animations: bool = False,
) -> dict[str, Path]:
    """Draw every picture that the run has the data for, into ``run_dir/figures``.

    The occupancy map needs an environment with ``cells`` (column and row of every state) and
    ``("info", "state")``.

    Args:
        run_dir: Folder of the run, with ``metrics.csv`` and maybe ``history.csv``.
        found: The set.
        baselines: Pooled CPL, then the oracle of each group; None without.
        board: What came out.
        evaluator: What evaluated it.
        world: Where policies act.
        reward_baselines: B-REX and DPL, where items are judged.
        with_animations: Whether to record a GIF for each group, where there is a renderer.

    Returns:
        Name and file of each picture.

    Warns:
        UserWarning: If pictures of a kind, or an animation, cannot be drawn; there are the others.
    """
    folder = run_dir / "figures"
    drawers = _drawers(run_dir, found, baselines, board, evaluator, world)
    drawers["motion"] = partial(draw_motion, found, board=board, evaluator=evaluator)
    drawers["rewards"] = partial(
        draw_rewards,
        found,
        baselines,
        board=board,
        evaluator=evaluator,
        reward_baselines=reward_baselines,
    )
    paths: dict[str, Path] = {}
    for what, draw_figures in drawers.items():
        with accessory(f"there is no picture of {what}", "the report has all numbers"):
            folder.mkdir(exist_ok=True)
            for name, figure in draw_figures().items():
                save(figure, folder / f"{name}.png")
                paths[name] = folder / f"{name}.png"
    if with_animations:
        paths |= animate(folder, found, board=board, world=world, seed=evaluator.seed)
    return paths


def _drawers(
    run_dir: Path,
    found: HypothesisSet,
    baselines: HypothesisSet | None,
    board: Scoreboard,
    evaluator: Evaluator,
    world: World,
) -> dict[str, Callable[[], dict[str, Figure]]]:
    """What draws the pictures of a kind, by the kind; none where the run lacks the data."""

    def learning() -> dict[str, Figure]:
        metrics = pd.read_csv(run_dir / "metrics.csv")
        figures = {"learning": plots.learning_curves(metrics)}
        if "selection_depth" in metrics:
            figures["selection"] = plots.selection(metrics)
        return figures

    def recovery() -> dict[str, Figure]:
        # Recovery is open without an oracle, or with one no better than random.
        table = board.results
        is_open = table.method.isin(["oracle", "random"])
        measured = (table.measure == headline_measure(table)) & ~is_open
        if not table.value[measured].notna().any():
            return {}
        floor = _FLOORS[evaluator.protocol.reference]
        return {"recovery": recovery_bars(table, floor=floor)}

    def snapshots() -> dict[str, Figure]:
        history = run_dir / "history.csv"
        if not history.exists() or len(evaluator.groups) < 2:
            return {}
        drawn = _draw_members(pd.read_csv(history), found, baselines, board, evaluator)
        return {"members": drawn}

    def places() -> dict[str, Figure]:
        cells = offered(world.env, "cells")
        if cells is None:
            return {}
        return {"occupancy": _draw_occupancy(cells, board, evaluator, world)}

    return {
        "learning": learning,
        "recovery": recovery,
        "members": snapshots,
        "occupancy": places,
    }


def _draw_members(
    snapshots: pd.DataFrame,
    found: HypothesisSet,
    baselines: HypothesisSet | None,
    board: Scoreboard,
    evaluator: Evaluator,
) -> Figure:
    """Draw the accuracies of all members in all generations that were written down."""
    names = [group.name for group in evaluator.groups]
    columns = [[c for c in map(str, snapshots) if c.rsplit("/", 1)[0] == name] for name in names]
    accuracy = np.stack([snapshots[column].to_numpy() for column in columns], -1)
    pooled, oracle = None, None
    if baselines is not None:
        rows = evaluator.accuracy(baselines).numpy()
        pooled = rows[0]
        oracle = {name: rows[1 + index] for index, name in enumerate(names)}
    return members(
        accuracy,
        snapshots.generation.tolist(),
        names,
        catered={
            name: found.origin[index] for name, index in board.catered.items() if found.origin
        },
        pooled=pooled,
        oracle=oracle,
    )


def _draw_occupancy(
    cells: torch.Tensor, board: Scoreboard, evaluator: Evaluator, world: World
) -> Figure:
    """Draw where the policies of the groups, and the pooled one, spend their steps."""
    names = [group.name for group in evaluator.groups]
    maps = {
        f"set, catered to {name}": occupancy_map(board.episodes[board.label, name], cells)
        for name in names
    }
    for pooled in ("pooled_cpl", "bradley_terry"):
        if (pooled, names[0]) in board.episodes:
            maps[method_name(pooled)] = occupancy_map(board.episodes[pooled, names[0]], cells)
    return plots.occupancy(
        picture(world),
        maps,
        suptitle="Where the policies go",
        caption="Each rater group gets its own policy from the set; pooled CPL is one policy "
        "for everybody.",
    )


def picture(world: World) -> NDArray[np.uint8] | None:
    """A picture of the environment at a start, or None if it draws none."""
    inner = world.env.unwrapped
    if "rgb_array" not in inner.metadata.get("render_modes", []):
        return None
    before, inner.render_mode = inner.render_mode, "rgb_array"
    image = None
    try:
        with accessory("there is no picture of the environment", "see what render() needs"):
            inner.reset(seed=0)
            image = inner.render()
            image = None if image is None else np.asarray(image, dtype=np.uint8)
    finally:
        inner.render_mode = before
    return image
