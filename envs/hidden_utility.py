"""States that nothing one does can change, and rater groups who value them differently.

There is nothing to learn but what people want: the stateless problem on which hidden context was
studied first (Siththaranjan et al., 2023, arXiv 2312.08358) and on which preference learning with
a set of hypotheses was shown (Boldi et al., 2024, arXiv 2406.15599). Data come in seconds.
"""

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.registry import env, rater

__all__ = [
    "HiddenUtility",
    "blend",
    "coin",
    "cycle_0",
    "cycle_third",
    "cycle_two_thirds",
    "doubled",
    "hidden_utility",
    "plain",
    "ring",
    "sample_states",
    "zeroed",
]

_SPLIT = 0.8  # from here the groups differ


class HiddenUtility(gymnasium.Env[Any, Any]):
    """See one random state after the other; there is nothing to do.

    Every observation is drawn independently and uniformly from the unit cube, float32
    ``[dimensions]``. The only action is 0, rewards are 0, and episodes end by ``max_steps`` alone,
    so that a segment of T steps is T independent states, wherever it is cut from an episode.

    Each ``info`` holds ``coin``, a number drawn uniformly from [0, 1) with each state and not part
    of the observation: that of the state in which the step was taken (at reset: of the first
    state), so that it lies beside this state in a segment. It is a hidden context that belongs to
    no person; only the raters ``coin`` and ``plane`` look at it.

    Args:
        dimensions: Coordinates of a state.
        max_steps: Steps after which an episode is truncated.
        render_mode: None, as there is nothing to draw.

    Raises:
        ValueError: If a count is below 1 or there is a render mode.
    """

    def __init__(
        self, *, dimensions: int = 1, max_steps: int = 1000, render_mode: str | None = None
    ) -> None:
        _check_counts(dimensions=dimensions, max_steps=max_steps)
        if render_mode is not None:
            raise ValueError(f"render_mode must be None (nothing is drawn), got {render_mode!r}.")
        self.dimensions = dimensions
        self.max_steps = max_steps
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (dimensions,), dtype=np.float32)
        self.action_space = gymnasium.spaces.Discrete(1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes this and the following ones reproducible."""
        super().reset(seed=seed, options=options)
        self._time = 0
        self._state, self._coin = self._drawn()
        return self._state, {"coin": self._coin}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Go on to the next state.

        Raises:
            ValueError: If the action is not 0.
        """
        if int(action) != 0:
            raise ValueError(f"action must be 0, the only one, got {action}.")
        before = self._coin
        self._time += 1
        self._state, self._coin = self._drawn()
        return self._state, 0.0, False, self._time >= self.max_steps, {"coin": before}

    def describe_segment(self, segment: TensorDictBase) -> str:
        """Return a segment ``[T]`` in words: the numbers of each of its states."""
        states = segment[OBSERVATION].tolist()
        return "\n".join("  ".join(f"{number:.2f}" for number in state) for state in states)

    def _drawn(self) -> tuple[NDArray[np.float32], np.float32]:
        """Return a new state and its coin."""
        numbers = self.np_random.random(self.dimensions + 1, dtype=np.float32)
        return numbers[:-1], numbers[-1]


@env("hidden_utility")
def hidden_utility(
    *, dimensions: int = 1, max_steps: int = 1000, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    """Make a ``HiddenUtility``, whose arguments these are."""
    return HiddenUtility(dimensions=dimensions, max_steps=max_steps, render_mode=render_mode)


def sample_states(
    count: int, *, dimensions: int = 1, length: int = 1, generator: torch.Generator
) -> TensorDict:
    """Draw segments without stepping through an environment.

    They are distributed as those that ``popl_rl.data.segments.collect_segments`` cuts from episodes
    of ``HiddenUtility``, and have the same keys.

    Args:
        count: Segments N.
        dimensions: Coordinates d of a state.
        length: States T in each segment.
        generator: Source of randomness, on whose device the result lies.

    Returns:
        TensorDict of batch size ``[N, T]`` with ``observation`` ``[N, T, d]``, ``action`` and
        ``reward`` (all 0) and ``("info", "coin")``, each ``[N, T]``.

    Raises:
        ValueError: If a count is below 1.
    """
    _check_counts(count=count, dimensions=dimensions, length=length)
    shape, device = (count, length), generator.device
    numbers = torch.rand(*shape, dimensions + 1, generator=generator, device=device)
    return TensorDict(
        {
            OBSERVATION: numbers[..., :-1].contiguous(),
            ACTION: torch.zeros(shape, dtype=torch.int64, device=device),
            REWARD: torch.zeros(shape, device=device),
            INFO: {"coin": numbers[..., -1].contiguous()},
        },
        batch_size=shape,
    )


@rater("zeroed")
def zeroed(segments: TensorDictBase) -> Tensor:
    """Want s to be large but below 0.8: from there it is worth 0. Group z = 0 of POPL."""
    s = _first(segments)
    return torch.where(s < _SPLIT, s, 0.0)


@rater("doubled")
def doubled(segments: TensorDictBase) -> Tensor:
    """Want s to be large, and from 0.8 all the more: there it is worth 2 s. Group z = 1 of POPL."""
    s = _first(segments)
    return torch.where(s < _SPLIT, s, 2 * s)


@rater("coin")
def coin(segments: TensorDictBase) -> Tensor:
    """Want s to be large, but from 0.8 it is worth 2 s (coin below 0.5) or 0.

    The problem of distributional preference learning (arXiv 2312.08358): one group, whose hidden
    context is thrown anew with each state instead of belonging to a person. A stored segment keeps
    its coin in every comparison that it is part of.
    """
    return torch.where(segments[INFO, "coin"] < 0.5, doubled(segments), zeroed(segments))


@rater("plain")
def plain(segments: TensorDictBase) -> Tensor:
    """Want s to be large. Nothing is hidden."""
    return _first(segments).clone()


@rater("cycle_0")
def cycle_0(segments: TensorDictBase) -> Tensor:
    """Want s to be large: the first of three groups whose majority prefers in circles."""
    return ring(segments, 0, 3)


@rater("cycle_third")
def cycle_third(segments: TensorDictBase) -> Tensor:
    """Want s + 1/3, modulo 1, to be large: best just below 2/3, worst from there."""
    return ring(segments, 1, 3)


@rater("cycle_two_thirds")
def cycle_two_thirds(segments: TensorDictBase) -> Tensor:
    """Want s + 2/3, modulo 1, to be large: best just below 1/3, worst from there."""
    return ring(segments, 2, 3)


@rater("ring")
def ring(segments: TensorDictBase, place: float, places: float = 1) -> Tensor:
    """Want s + place / places, modulo 1, to be large.

    The utilities of neighbours on the ring overlap: two whose places are a share d apart order
    ``d^2 + (1 - d)^2`` of all pairs of states alike.

    Args:
        segments: Segments ``[B, T]`` of `HiddenUtility`.
        place: Place on the ring.
        places: Length of the ring.
    """
    return (_first(segments) + place / places).remainder(1)


@rater("blend")
def blend(segments: TensorDictBase, weight: float) -> Tensor:
    """Want both coordinates of a state to be large, the first ``weight`` times as much.

    Args:
        segments: Segments ``[B, T]`` of `HiddenUtility` with two coordinates (or more, of
            which only two count).
        weight: Weight of the first coordinate; the second has the rest to 1.

    Raises:
        ValueError: If states have a single coordinate.
    """
    states: Tensor = segments[OBSERVATION]
    if states.shape[-1] < 2:
        raise ValueError(
            "rater 'blend' judges states of 2 coordinates, got 1; take env.options.dimensions=2."
        )
    return weight * states[..., 0] + (1 - weight) * states[..., 1]


def _first(segments: TensorDictBase) -> Tensor:
    """Return the first coordinate of each state, ``[B, T]``."""
    states: Tensor = segments[OBSERVATION]
    return states[..., 0]


def _check_counts(**counts: int) -> None:
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}.")


if "popl_rl/HiddenUtility-v0" not in gymnasium.registry:
    gymnasium.register(
        "popl_rl/HiddenUtility-v0", entry_point="popl_rl.envs.hidden_utility:HiddenUtility"
    )
