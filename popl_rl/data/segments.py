"""Behaviour data: episodes, cut into fixed-length segments, stored once in a replay buffer."""

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorStorage

from popl_rl.data.behaviours import Behaviour
from popl_rl.data.rollouts import MASK
from popl_rl.data.table_rollouts import Rollouts
from popl_rl.keys import INFO
from popl_rl.locks import locked
from popl_rl.manifest import digest_of_tensors
from popl_rl.processes import Workers
from popl_rl.storage import map_tensordict, save_tensordict

__all__ = ["collect_segments", "cut_segments", "segment_buffer", "stored_segments"]


def cut_segments(episodes: TensorDictBase, length: int) -> TensorDict:
    """Cut episodes into consecutive segments, counted back from each episode's end.

    Counting from the end keeps the last step, where a goal is reached, in a segment; the steps
    left over at the start are dropped.

    Args:
        episodes: Output of ``popl_rl.data.rollouts.lockstep``, ``[B, H]``.
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
    workers: Workers | None = None,
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
        workers: Processes that step them side by side, with the same result; this one if None.
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
    _check_counts(counts)
    given = _checked_shares(behaviours, shares)
    collected: list[TensorDict] = []
    total, reached = 0, 0.0
    with Rollouts(make_env, workers) as roll:
        for name, behaviour in behaviours.items():
            reached += given.get(name, 0.0)
            quota = round(reached * num_segments)
            barren = 0
            while total < quota:
                seeds = torch.randint(2**31, (num_envs,), generator=generator).tolist()
                if hasattr(behaviour, "reset"):
                    behaviour.reset()
                act = partial(_act, behaviour, generator)
                episodes = roll(act, seeds=seeds, max_steps=max_steps)
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
    everything: TensorDict = torch.cat(_alike(collected))  # type: ignore[call-overload]
    return everything[torch.randperm(total, generator=generator)]


def _alike(batches: list[TensorDict]) -> list[TensorDict]:
    """Batches with the same numbers in ``info``: 0 where none of a batch's infos had one."""
    names = [set(batch[INFO].keys()) for batch in batches]
    for batch, own in zip(batches, names, strict=True):
        for name in sorted(set().union(*names) - own):
            batch[INFO, name] = torch.zeros(batch.batch_size)
    return batches


def _check_counts(counts: Mapping[str, int]) -> None:
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def _checked_shares(
    behaviours: Mapping[str, Behaviour], shares: Mapping[str, float] | None
) -> dict[str, float]:
    """Share of the segments that each behaviour gives; none if it is not named."""
    if not behaviours:
        raise ValueError("behaviours must hold at least one behaviour, got none")
    given = dict.fromkeys(behaviours, 1 / len(behaviours)) if shares is None else dict(shares)
    proper = given.keys() <= behaviours.keys() and all(share >= 0 for share in given.values())
    if not proper or not abs(sum(given.values()) - 1) < 1e-6:
        raise ValueError(
            f"shares must be non-negative, sum to 1 and name behaviours out of {list(behaviours)}, "
            f"got {given}"
        )
    return given


def _act(behaviour: Behaviour, generator: torch.Generator, step: TensorDictBase) -> Tensor:
    return behaviour(step, generator)


def segment_buffer(
    segments: TensorDictBase, *, memmap: Path | None = None, batch_size: int = 32
) -> TensorDictReplayBuffer:
    """Store segments, one item each, in a replay buffer.

    Args:
        segments: ``[N, T]``.
        memmap: Folder for memory-mapped storage; in memory if None. Each data set has a folder of
            its own below it, named after its digest, which is made once and read again by whoever
            has the same segments.
        batch_size: Segments per ``sample()``.

    Returns:
        A buffer of N items, in the order of ``segments``.

    Raises:
        OSError: If there is no room for memory-mapped storage.
    """
    size = len(segments)
    # One item is one segment: the time axis belongs to the leaves, not to the batch.
    items = segments.copy().auto_batch_size_(1)
    storage = LazyTensorStorage(size) if memmap is None else TensorStorage(_mapped(items, memmap))
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=min(batch_size, size))
    if memmap is None:
        buffer.extend(items)
    return buffer


def _mapped(segments: TensorDictBase, folder: Path) -> TensorDict:
    """The same segments as memory maps, checked to be the same to the last byte."""
    digest = digest_of_tensors(segments)[""]
    path = folder / f"segments-{digest}"
    with locked(path):
        if path.is_dir():
            with suppress(Exception):  # whatever is wrong with a copy, it is made anew
                return map_tensordict(path, digest=digest)
            shutil.rmtree(path)
        save_tensordict(segments, path)
        return map_tensordict(path, digest=digest)


def stored_segments(buffer: TensorDictReplayBuffer) -> TensorDict:
    """All segments of a buffer in the order in which they were stored, ``[N, T]``."""
    # The buffer adds each item's index, which has no time axis.
    segments: TensorDict = buffer[:].exclude("index").auto_batch_size_(2)
    return segments
