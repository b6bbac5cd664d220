"""Minigrid's lava gap with a way around, for bold people and cautious ones."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

import gymnasium
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Goal, Lava
from minigrid.minigrid_env import MiniGridEnv
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.envs.listed_minigrid import ListedMinigrid, MinigridListing
from popl_rl.keys import INFO
from popl_rl.registry import env, rater

__all__ = ["LavaGap", "bold", "cautious", "lava_gap"]

_MIN_SIZE = 9


class LavaGap(MiniGridEnv):
    """Reach the goal beyond a strip of lava: through its gap, or around its end.

    As Minigrid's ``LavaGap``, a strip of lava stands between start and goal, with a gap of one
    cell. Here it ends four rows above the lower wall, so that one can also go around it without
    ever standing beside lava. The agent starts in one of the upper three rows left of the lava, the
    goal is on the other side, level with the gap in the second row. Stepping into lava ends the
    episode.

    Args:
        size: Cells along each side, outer walls included; odd, at least 9.

    Raises:
        ValueError: If ``size`` is even or too small.
    """

    def __init__(self, *, size: int = 9) -> None:
        if size < _MIN_SIZE or size % 2 == 0:
            raise ValueError(f"size must be odd and at least {_MIN_SIZE}, got {size}.")
        super().__init__(
            mission_space=MissionSpace(mission_func=_mission),
            grid_size=size,
            max_steps=10**6,  # ``ListedMinigrid`` counts
        )

    def _gen_grid(self, width: int, height: int) -> None:
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        strip = width // 2
        self.grid.vert_wall(strip, 1, height - 5, Lava)
        self.grid.set(strip, 2, None)
        self.grid.set(width - 2, 2, Goal())
        self.place_agent(top=(1, 1), size=(strip - 1, 3))  # type: ignore[no-untyped-call]


@env("lava_gap")
def lava_gap(
    *,
    size: int = 9,
    view: Literal["full", "partial"] = "full",
    start: Literal["own", "anywhere", "mixed"] = "own",
    max_steps: int = 60,
    render_mode: str | None = None,
) -> gymnasium.Env[Any, Any]:
    """Make a ``LavaGap``, whose states are listed from 24 starts; see ``ListedMinigrid``.

    ``info`` holds ``goal``, ``near`` (1 if the step ends with lava in one of the eight cells
    around) and ``accident`` (1 if it ends in lava).
    """
    made: gymnasium.Env[Any, Any] = ListedMinigrid(
        _listing(size),
        raters={"bold": bold, "cautious": cautious},
        view=view,
        start=start,
        max_steps=max_steps,
        render_mode=render_mode,
    )
    return made


@cache
def _listing(size: int) -> MinigridListing:
    return MinigridListing(LavaGap(size=size), seeds=range(24), numbers=_numbers)


@rater("bold")
def bold(segments: TensorDictBase) -> Tensor:
    """Want the goal soon, however near the danger: 0.1 lost per step, 1 in an accident."""
    goal: Tensor = segments[INFO, "goal"]
    accident: Tensor = segments[INFO, "accident"]
    return goal.float() - 0.1 - accident.float()


@rater("cautious")
def cautious(segments: TensorDictBase) -> Tensor:
    """Want the goal, and no step beside danger: 0.02 lost per step, 0.5 more there, 2 in it."""
    goal: Tensor = segments[INFO, "goal"]
    near: Tensor = segments[INFO, "near"]
    accident: Tensor = segments[INFO, "accident"]
    return goal.float() - 0.02 - 0.5 * near.float() - 2.0 * accident.float()


def _numbers(simulator: MiniGridEnv) -> Mapping[str, float]:
    x, y = (int(place) for place in simulator.agent_pos)
    cells = [simulator.grid.get(i, j) for i in range(x - 1, x + 2) for j in range(y - 1, y + 2)]
    near = any(cell is not None and cell.type == "lava" for cell in cells)
    here = simulator.grid.get(x, y)
    return {"near": int(near), "accident": int(here is not None and here.type == "lava")}


def _mission() -> str:
    return "avoid the lava and get to the green goal square"


if "popl_rl/LavaGap-v0" not in gymnasium.registry:
    gymnasium.register("popl_rl/LavaGap-v0", entry_point="popl_rl.envs.lava_gap:lava_gap")
