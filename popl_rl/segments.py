"""Behaviour data: episodes, cut into fixed-length segments, stored once in a replay buffer."""

import json
import math
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer

from popl_rl.keys import ACTION, INFO, OBSERVATION
from popl_rl.rollouts import MASK, lockstep

__all__ = [
    "Behaviour",
    "SegmentBank",
    "collect_segments",
    "cut_segments",
    "load_tensordict",
    "random_behaviour",
    "save_tensordict",
    "segment_buffer",
    "stored_segments",
    "table_behaviour",
]

#: Maps a TensorDict ``[B]`` of current observations and a generator to actions.
Behaviour = Callable[[TensorDictBase, torch.Generator], Tensor]


def table_behaviour(probabilities: Tensor) -> Behaviour:
    """A behaviour from a table ``[S, A]`` of action probabilities, looked up by state index."""

    def act(step: TensorDictBase, generator: torch.Generator) -> Tensor:
        rows = probabilities[step[INFO, "next_state"].long()]
        return torch.multinomial(rows, 1, generator=generator).squeeze(-1)

    return act


def random_behaviour(action_space: gymnasium.Space[Any]) -> Behaviour:
    """Uniformly random actions of a ``Discrete`` or bounded ``Box`` space.

    Raises:
        TypeError: If the space is neither, or a ``Box`` without bounds.
    """
    if isinstance(action_space, gymnasium.spaces.Discrete):
        count = int(action_space.n)
        return lambda step, generator: torch.randint(count, step.batch_size, generator=generator)
    if isinstance(action_space, gymnasium.spaces.Box) and action_space.is_bounded():
        low, high = (torch.as_tensor(end).float() for end in (action_space.low, action_space.high))
        return lambda step, generator: (
            low + (high - low) * torch.rand(*step.batch_size, *low.shape, generator=generator)
        )
    raise TypeError(f"action_space must be Discrete or a bounded Box, got {action_space}")


def cut_segments(episodes: TensorDictBase, length: int) -> TensorDict:
    """Cut episodes into consecutive segments, counted back from each episode's end.

    Counting from the end keeps the last step, where a goal is reached, in a segment; the steps
    left over at the start are dropped.

    Args:
        episodes: Output of :func:`~popl_rl.rollouts.lockstep`, ``[B, H]``.
        length: Steps T of a segment.

    Returns:
        TensorDict ``[N, T]`` without the mask; N is 0 if every episode is shorter than T.
    """
    ends = episodes[MASK].sum(1)
    steps = torch.arange(length)
    rows, starts = [], []
    for back in range(1, episodes.shape[1] // length + 1):
        start = ends - back * length
        row = (start >= 0).nonzero().squeeze(-1)
        rows.append(row)
        starts.append(start[row])
    if not rows:
        rows, starts = [torch.empty(0, dtype=torch.long)], [torch.empty(0, dtype=torch.long)]
    row, start = torch.cat(rows), torch.cat(starts)
    return episodes.exclude(MASK)[row[:, None], start[:, None] + steps]


def collect_segments(
    make_env: Callable[[], gymnasium.Env[Any, Any]],
    behaviours: Mapping[str, Behaviour],
    *,
    num_segments: int,
    length: int,
    generator: torch.Generator,
    shares: Mapping[str, float] | None = None,
    max_steps: int = 1000,
    num_envs: int = 64,
    progress: Callable[[int], None] | None = None,
) -> TensorDict:
    """Collect segments of several behaviours.

    Args:
        make_env: Builds one environment.
        behaviours: Behaviours by name. One with a ``reset`` method has it called before each batch
            of episodes.
        num_segments: Segments N in all.
        length: Steps T of a segment.
        generator: Source of seeds and of the behaviours' randomness.
        shares: Share of the segments that each behaviour gives, summing to 1; equal if None.
        max_steps: Steps after which an episode is cut.
        num_envs: Environments that advance together.
        progress: Called with the number of segments collected so far.

    Returns:
        TensorDict ``[N, T]`` in a random order.

    Raises:
        ValueError: If a count is not positive, there are no behaviours, ``shares`` are no shares of
            them, or episodes are shorter than ``length``.
    """
    counts = {
        "num_segments": num_segments,
        "length": length,
        "max_steps": max_steps,
        "num_envs": num_envs,
    }
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if not behaviours:
        raise ValueError("behaviours must hold at least one behaviour, got none")
    given = dict.fromkeys(behaviours, 1 / len(behaviours)) if shares is None else dict(shares)
    proper = given.keys() <= behaviours.keys() and all(share >= 0 for share in given.values())
    if not proper or not abs(sum(given.values()) - 1) < 1e-6:
        raise ValueError(
            f"shares must be non-negative, sum to 1 and name behaviours out of {list(behaviours)}, "
            f"got {given}"
        )
    envs = [make_env() for _ in range(num_envs)]
    collected: list[TensorDict] = []
    total, reached = 0, 0.0
    try:
        for name, behaviour in behaviours.items():
            reached += given.get(name, 0.0)
            quota = round(reached * num_segments)
            barren = 0
            while total < quota:
                seeds = torch.randint(2**31, (num_envs,), generator=generator).tolist()
                if hasattr(behaviour, "reset"):
                    behaviour.reset()
                act = partial(_act, behaviour, generator)
                episodes = lockstep(envs, act, seeds=seeds, max_steps=max_steps)
                segments = cut_segments(episodes, length)
                barren = 0 if len(segments) else barren + 1
                if barren == 5:
                    longest = int(episodes[MASK].sum(1).max())
                    raise ValueError(
                        f"length must not exceed the episodes' length: {5 * num_envs} episodes of "
                        f"behaviour {name!r} gave no segment of {length} steps (the longest of the "
                        f"last {num_envs} had {longest}); choose shorter segments"
                    )
                order = torch.randperm(len(segments), generator=generator)[: quota - total]
                collected.append(segments[order])
                total += len(order)
                if progress is not None:
                    progress(total)
    finally:
        for env in envs:
            env.close()
    everything: TensorDict = torch.cat(collected)  # type: ignore[call-overload]
    return everything[torch.randperm(total, generator=generator)]


def _act(behaviour: Behaviour, generator: torch.Generator, step: TensorDictBase) -> Tensor:
    return behaviour(step, generator)


def segment_buffer(
    segments: TensorDictBase, *, memmap: Path | None = None, batch_size: int = 32
) -> TensorDictReplayBuffer:
    """Store segments, one item each, in a replay buffer.

    Args:
        segments: ``[N, T]``.
        memmap: Folder for memory-mapped storage; in memory if None.
        batch_size: Segments per ``sample()``.
    """
    size = len(segments)
    storage = (
        LazyTensorStorage(size) if memmap is None else LazyMemmapStorage(size, scratch_dir=memmap)
    )
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=min(batch_size, size))
    # One item is one segment: the time axis belongs to the leaves, not to the batch.
    buffer.extend(segments.copy().auto_batch_size_(1))
    return buffer


def stored_segments(buffer: TensorDictReplayBuffer) -> TensorDict:
    """All segments of a buffer in the order in which they were stored, ``[N, T]``."""
    # The buffer adds each item's index, which has no time axis.
    segments: TensorDict = buffer[:].exclude("index").auto_batch_size_(2)
    return segments


@dataclass(frozen=True)
class SegmentBank:
    """Segments as the learner reads them: observations and actions only.

    Attributes:
        observation: Distinct observations ``[U, O]`` (all of them, ``U = N T``, if few repeat).
        row: Row of ``observation`` seen at each step, ``[N, T]``.
        action: ``[N, T]`` int64 or ``[N, T, A]`` float32.
        is_shared: Whether observations repeat, so that ``U`` is small against ``N T``.
    """

    observation: Tensor
    row: Tensor
    action: Tensor
    is_shared: bool

    def __len__(self) -> int:
        return self.row.shape[0]

    @classmethod
    def from_segments(cls, segments: TensorDictBase) -> "SegmentBank":
        """Index segments ``[N]`` or ``[N, T]`` by their distinct observations."""
        observation, action = segments[OBSERVATION], segments[ACTION]
        flat = observation.flatten(0, 1)
        distinct, inverse = flat.unique(dim=0, return_inverse=True)
        if len(distinct) <= len(flat) // 4:
            return cls(distinct, inverse.view(observation.shape[:2]), action, True)
        row = torch.arange(len(flat), device=flat.device).view(observation.shape[:2])
        return cls(flat, row, action, False)

    def subset(self, index: Tensor) -> "SegmentBank":
        """Some of the segments, in the order of ``index``."""
        row, action = self.row[index], self.action[index]
        if self.is_shared:
            return SegmentBank(self.observation, row, action, True)
        own = torch.arange(row.numel(), device=row.device).view(row.shape)
        return SegmentBank(self.observation[row.flatten()], own, action, False)

    def to(self, device: torch.device | str) -> "SegmentBank":
        """The same segments on another device."""
        return SegmentBank(
            self.observation.to(device), self.row.to(device), self.action.to(device), self.is_shared
        )


def save_tensordict(data: TensorDictBase, path: Path) -> None:
    """Write a TensorDict as memory maps and JSON: beside the target first, then renamed.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or choose another path")
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        data.detach().cpu().clone().memmap(beside / "data", copy_existing=True)
        (beside / "data").rename(path)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def load_tensordict(path: Path, *, required: Mapping[str, int] | None = None) -> TensorDict:
    """Read what :func:`save_tensordict` wrote, into memory.

    Args:
        path: Folder to read.
        required: Keys that must be there and the least number of dimensions of each.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If the folder is truncated, damaged, or holds something else.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"no saved data at {path}: expected the folder of an earlier run")
    try:
        _check_whole(path)
        data: TensorDict = TensorDict.load_memmap(path, allow_pickle=False).clone()
    except Exception as error:
        raise ValueError(
            f"{path} is not readable as saved data ({error}); it is truncated or was written by "
            "something else; use another path or collect it again"
        ) from error
    for key, ndim in (required or {}).items():
        if key not in data.keys(True) or (ndim and data[key].ndim < ndim):
            raise ValueError(
                f"{path} does not hold what was expected: {key!r} with at least {ndim} dimensions "
                f"is missing; it has {sorted(map(str, data.keys(True, True)))}"
            )
    return data


def _check_whole(path: Path) -> None:
    """Compare the size of the files with what ``meta.json`` declares, at every level.

    Loading would fill what is missing with zeros, and lengthen the file.
    """
    for about in path.rglob("meta.json"):
        entries = json.loads(about.read_text()).values()
        declared = sum(
            math.prod(entry["shape"])
            * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
            for entry in entries
            if isinstance(entry, dict) and "dtype" in entry
        )
        held = sum(file.stat().st_size for file in about.parent.glob("*.memmap"))
        if held != declared:
            raise ValueError(f"{about.parent} holds {held} bytes of tensors instead of {declared}")
