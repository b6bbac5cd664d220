"""Segments cut from the episodes of a Minari data set on this machine."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from popl_rl.keys import ACTION, MASK, OBSERVATION

__all__ = ["minari_segments"]


def minari_segments(path: Path, *, length: int | None = None) -> TensorDict:
    """Cut the episodes of a local Minari data set into segments, one after the other.

    Args:
        path: Folder of the data set, the one that holds ``data/main_data.hdf5``, or its ``data``.
        length: Steps of a segment; whole episodes if None. A last, shorter segment of an episode
            is kept, with a mask.

    Returns:
        TensorDict ``[N, T]`` with ``observation``, ``action``, ``reward`` and, where segments
        differ in length, ``mask``.

    Raises:
        ValueError: If the package ``minari`` or ``h5py`` is missing;
            if observations are no vectors of numbers, or ``length`` is below 1.
    """
    if importlib.util.find_spec("minari") is None or importlib.util.find_spec("h5py") is None:
        raise ValueError(
            f"{path} is a Minari data set, which needs the packages minari and h5py: "
            "pip install 'popl_rl[people]'"
        )
    if length is not None and length < 1:
        raise ValueError(f"length must be at least 1 or None, got {length}")
    from minari import MinariDataset

    data = MinariDataset(path if path.name == "data" else path / "data")
    pieces: list[tuple[Any, Any, Any]] = []
    for episode in data.iterate_episodes():
        observed, taken, reward = episode.observations, episode.actions, episode.rewards
        if not isinstance(observed, np.ndarray) or observed.ndim != 2:
            raise ValueError(
                f"{path} must hold observations that are vectors of numbers, got "
                f"{type(observed).__name__}; flatten them before"
            )
        size = length or len(taken)
        for begin in range(0, len(taken), size):
            part = slice(begin, min(begin + size, len(taken)))
            pieces.append((observed[part], taken[part], reward[part]))
    longest = max(len(taken) for _, taken, _ in pieces)
    mask = torch.tensor([[step < len(taken) for step in range(longest)] for _, taken, _ in pieces])

    def padded(which: int) -> torch.Tensor:
        rows = [np.pad(p[which], _padding(p[which], longest), mode="edge") for p in pieces]
        return torch.from_numpy(np.stack(rows))

    action = padded(1)
    steps = {
        OBSERVATION: padded(0).float(),
        ACTION: action.float() if action.is_floating_point() else action.long(),
        "reward": padded(2).float(),
    }
    if not mask.all():
        steps[MASK] = mask
    return TensorDict(steps, list(mask.shape))


def _padding(values: Any, longest: int) -> list[tuple[int, int]]:
    return [(0, longest - len(values)), *[(0, 0)] * (values.ndim - 1)]
