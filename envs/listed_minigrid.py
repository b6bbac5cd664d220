"""Minigrid's worlds with every state listed: exact labels, exact optima, and quick steps."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from minigrid.core.grid import Grid
from minigrid.core.world_object import WorldObj
from minigrid.minigrid_env import MiniGridEnv
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot

from popl_rl.data.enumeration import Outcome, enumerate_states
from popl_rl.data.tables import Table, solve
from popl_rl.envs.explorer import Explorer
from popl_rl.keys import INFO, REWARD
from popl_rl.raters.groups import Utility

__all__ = ["ListedMinigrid", "MinigridListing"]

_Sign = tuple[Any, ...]  # tells an object of a grid from others; empty for none


class MinigridListing:
    """All states of some layouts of a Minigrid world, found once for all of its environments.

    The future of a state must depend on the grid, on where the agent is and looks, and on what it
    carries alone. Each step of the list has the numbers ``state`` (index of the state before it),
    ``next_state``, ``goal`` (1 if it was rewarded), and what ``numbers`` says. Its reward is 1, 0
    or -1, the sign of Minigrid's, whose discount for time is left out.

    Args:
        simulator: The world, without wrappers.
        seeds: Seeds of the layouts, each as likely as the others.
        numbers: What raters go by besides: a function of the simulator after a step, which gives
            numbers of the same names every time.
        actions: Minigrid's actions that there are, numbered from 0 in this order: 0 turn left, 1
            turn right, 2 forward, 3 pick up, 4 drop, 5 toggle.
        most: States at which to give up.

    Attributes:
        cells: ``[S, 2]`` int64, column and row of every state, for maps of occupancy.
        places: ``[S, K]`` int64, column and row, and whatever else can be changed.

    Raises:
        ValueError: If there are no seeds or more than ``most`` states.

    Example:
        >>> from minigrid.envs.empty import EmptyEnv
        >>> listing = MinigridListing(EmptyEnv(size=5))
        >>> env = ListedMinigrid(listing, max_steps=20)
    """

    def __init__(
        self,
        simulator: MiniGridEnv,
        *,
        seeds: Sequence[int] = (0,),
        numbers: Callable[[MiniGridEnv], Mapping[str, float]] | None = None,
        actions: Sequence[int] = (0, 1, 2),
        most: int = 20_000,
    ) -> None:
        if not seeds:
            raise ValueError("seeds must name at least one layout, got none.")
        first: dict[_Snapshot, float] = {}
        for seed in seeds:
            simulator.reset(seed=seed)
            state = _Snapshot(simulator)
            first[state] = first.get(state, 0.0) + 1.0

        def step(state: _Snapshot, action: int) -> Outcome[_Snapshot]:
            state.put(simulator)
            _, reward, terminal, _, _ = simulator.step(actions[action])
            sign = float(np.sign(float(reward)))
            info = {"goal": int(sign > 0), **(numbers(simulator) if numbers else {})}
            return Outcome(_Snapshot(simulator), bool(terminal), sign, info)

        self._simulator = simulator
        self._found = enumerate_states(first, len(actions), step, most=most)
        agents, *things = zip(*(state.key for state in self._found.states), strict=True)
        own = [_codes(part) for part in zip(*agents, strict=True)]
        rest = [_codes(part) for part in things if len(set(part)) > 1]
        full = torch.cat([one_hot(part) for part in own + rest], 1).float()
        self._views: dict[str, NDArray[Any]] = {"full": full.numpy()}
        self._tables: dict[tuple[str, str], Table] = {}
        self.cells = torch.tensor([agent[:2] for agent in agents])
        self.places = torch.cat([self.cells, *(part.unsqueeze(1) for part in rest)], 1)

    def view(self, view: str) -> NDArray[Any]:
        """What is seen in each state, ``[S, ...]``; see ``ListedMinigrid``."""
        if view not in self._views:
            images = []
            for state in self._found.states:
                state.put(self._simulator)
                seen = self._simulator.gen_obs()  # type: ignore[no-untyped-call]
                images.append(seen["image"])
            self._views[view] = np.stack(images)
        return self._views[view]

    def table(self, view: str = "full", start: str = "own") -> Table:
        """The transition table with these observations and first states; see ``ListedMinigrid``."""
        if (view, start) not in self._tables:
            table = self._found.table(torch.from_numpy(self.view(view)).flatten(1))
            going_on = (~table.terminal.all(1)).float()
            share = {"own": 1.0, "anywhere": 0.0, "mixed": 0.5}[start]
            first = share * table.start + (1 - share) * going_on / going_on.sum()
            self._tables[view, start] = replace(table, start=first)
        return self._tables[view, start]

    def picture(self, state: int) -> NDArray[np.uint8]:
        """Draw a state as Minigrid does, ``[H, W, 3]``."""
        self._found.states[state].put(self._simulator)
        frame: NDArray[np.uint8] = self._simulator.get_frame(highlight=False, tile_size=24)
        return frame


class ListedMinigrid(gymnasium.Env[Any, Any]):
    """A Minigrid world whose states are listed: steps are looked up, Minigrid draws pictures.

    Each ``info`` holds the numbers of the list (see ``MinigridListing``); at reset ``state`` and
    ``next_state`` are the first state, and the others are 0.

    Args:
        listing: The world's states.
        raters: Groups whose planners the data may show, by name.
        view: "full": float32, one-hot column, row and direction of the agent, and one-hot codes of
            whatever differs between states elsewhere in the grid or in what is carried. "partial":
            Minigrid's own view, ``[7, 7, 3]`` uint8, kinds, colours and states of the cells ahead.
        start: "own": as the layouts have it; "anywhere": any state in which an episode goes on;
            "mixed": either with equal chance.
        max_steps: Steps after which an episode is truncated.
        render_mode: None or "rgb_array".

    Attributes:
        cells: ``[S, 2]`` int64, column and row of every state, for maps of occupancy.

    Raises:
        ValueError: If an argument is out of its range.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}

    def __init__(
        self,
        listing: MinigridListing,
        *,
        raters: Mapping[str, Utility] | None = None,
        view: Literal["full", "partial"] = "full",
        start: Literal["own", "anywhere", "mixed"] = "own",
        max_steps: int = 60,
        render_mode: str | None = None,
    ) -> None:
        if view not in ("full", "partial"):
            raise ValueError(f"view must be 'full' or 'partial', got {view!r}.")
        if start not in ("own", "anywhere", "mixed"):
            raise ValueError(f"start must be 'own', 'anywhere' or 'mixed', got {start!r}.")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        self.max_steps, self.render_mode = max_steps, render_mode
        self.cells = listing.cells
        self._listing, self._raters = listing, dict(raters or {})
        self._seen, table = listing.view(view), listing.table(view, start)
        self._table = table
        # As arrays, because a step takes single numbers of them.
        self._next, self._ends = table.next_state.numpy(), table.terminal.numpy()
        self._reward = table.steps[REWARD].numpy()
        info = table.steps[INFO].exclude("state", "next_state")
        self._info = {name: value.numpy() for name, value in info.items()}
        self._chances = table.start.double().numpy()
        self._chances /= self._chances.sum()
        self._state, self._time = 0, 0
        self.action_space = gymnasium.spaces.Discrete(len(self._next[0]))
        # Minigrid's codes of kinds, colours and states are small.
        high, kind = (1.0, np.float32) if view == "full" else (10, np.uint8)
        self.observation_space = gymnasium.spaces.Box(0, high, self._seen.shape[1:], dtype=kind)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode; a seed makes this and the following ones reproducible."""
        super().reset(seed=seed, options=options)
        self._time = 0
        self._state = int(self.np_random.choice(len(self._chances), p=self._chances))
        first = {name: value.dtype.type(0) for name, value in self._info.items()}
        return self._seen[self._state].copy(), first | self._places(self._state)

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Take an action.

        Raises:
            ValueError: If there is no such action.
        """
        chosen, before = int(action), self._state
        if not 0 <= chosen < len(self._next[0]):
            raise ValueError(f"action must be from 0 to {len(self._next[0]) - 1}, got {action}.")
        self._time += 1
        self._state = int(self._next[before, chosen])
        info = {name: value[before, chosen] for name, value in self._info.items()}
        return (
            self._seen[self._state].copy(),
            float(self._reward[before, chosen]),
            bool(self._ends[before, chosen]),
            self._time >= self.max_steps,
            info | self._places(before),
        )

    def transition_table(self) -> Table:
        """Return every transition of this environment, exactly."""
        return self._table

    def behaviours(self) -> dict[str, Tensor | Explorer]:
        """Return what data can show: planners, an explorer and random actions.

        Returns:
            By name: ``planner/<rater>/<temperature>``, tables ``[S, A]`` of action probabilities,
            softmax(advantage / temperature) of the raters' optimal advantages; ``explorer``, who
            goes from place to place, where doors and what is carried make places different;
            ``random``, the uniform table.
        """
        behaviours: dict[str, Tensor | Explorer] = {}
        for name, utility in self._raters.items():
            advantages, _values = solve(self._table, utility(self._table.steps))
            for temperature in (0.03, 0.1, 0.3):
                behaviours[f"planner/{name}/{temperature}"] = (advantages / temperature).softmax(-1)
        behaviours["explorer"] = Explorer(self._table, self._listing.places)
        shape = self._table.next_state.shape
        behaviours["random"] = torch.full(shape, 1 / shape[1])
        return behaviours

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw the present state as Minigrid does, ``[H, W, 3]``."""
        return None if self.render_mode is None else self._listing.picture(self._state)

    def render_segment(self, segment: TensorDictBase) -> list[NDArray[np.uint8]]:
        """Return the pictures of a segment ``[T]``: before its first step, and after each."""
        states = [int(segment[INFO, "state"][0]), *segment[INFO, "next_state"].tolist()]
        return [self._listing.picture(state) for state in states]

    def _places(self, before: int) -> dict[str, Any]:
        # NumPy numbers, because TorchRL's reader of infos asks each value for its dtype.
        return {"state": np.int64(before), "next_state": np.int64(self._state)}


class _Snapshot:
    """A state of the simulator, equal to others by what can be seen of it."""

    __slots__ = ("agent", "carrying", "cells", "key")

    def __init__(self, simulator: MiniGridEnv) -> None:
        self.cells: list[WorldObj | None] = list(simulator.grid.grid)
        self.carrying: WorldObj | None = simulator.carrying
        x, y = simulator.agent_pos
        self.agent = int(x), int(y), int(simulator.agent_dir)
        self.key = self.agent, *(_sign(thing) for thing in (self.carrying, *self.cells))

    def put(self, simulator: MiniGridEnv) -> None:
        """Bring a simulator into this state."""
        grid = Grid(simulator.grid.width, simulator.grid.height)
        grid.grid = [_copied(thing) for thing in self.cells]
        simulator.grid = grid
        simulator.carrying = _copied(self.carrying)  # type: ignore[assignment]
        x, y, simulator.agent_dir = self.agent
        simulator.agent_pos, simulator.step_count = (x, y), 0

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Snapshot) and self.key == other.key


def _sign(thing: WorldObj | None) -> _Sign:
    if thing is None:
        return ()
    return (*thing.encode(), _sign(thing.contains))


def _copied(thing: WorldObj | None) -> WorldObj | None:
    """A copy that can be changed; what never changes as it is."""
    if thing is None or thing.type in ("wall", "floor", "goal", "lava"):
        return thing
    copied = copy(thing)
    copied.contains = _copied(thing.contains)  # type: ignore[assignment]
    return copied


def _codes(values: Sequence[Any]) -> Tensor:
    """Number of each value among the different ones, in their order, ``[S]`` int64."""
    numbers = {value: number for number, value in enumerate(sorted(set(values)))}
    return torch.tensor([numbers[value] for value in values])
