"""Segments and preferences in a folder: written together, and checked whenever they are read."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from popl_rl.keys import ACTION, ANSWER, CHANCE, GROUP, OBSERVATION, PAIR, RANKING, RATER, Answer
from popl_rl.manifest import digest_of_tensors
from popl_rl.storage import load_tensordict, read_manifest, save_tensordict

__all__ = [
    "check_preferences",
    "check_segments",
    "load_preferences",
    "load_segments",
    "save_preferences",
    "segments_digest",
]


def segments_digest(folder: Path, segments: TensorDictBase) -> str:
    """Digest of segments that were read from a folder; computed if the folder has no manifest."""
    manifest = read_manifest(folder)
    return digest_of_tensors(segments)[""] if manifest is None else str(manifest["digest"])


def save_preferences(
    preferences: TensorDictBase,
    path: Path,
    *,
    segments: str,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write preferences with the digest of the segments that they compare.

    Args:
        preferences: TensorDict ``[M]``.
        path: The folder to be.
        segments: Digest of the segments.
        about: What else their manifest says.

    Raises:
        FileExistsError: If ``path`` exists.
        OSError: If there is no room.
    """
    save_tensordict(preferences, path, about={**(about or {}), "segments": segments})


def load_segments(path: Path, *, required: Mapping[str, int] | None = None) -> TensorDict:
    """Read segments ``[N, T]``.

    Args:
        path: The folder.
        required: Keys besides observation and action, and the least number of dimensions of each.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it is damaged, was changed, or holds something else.
    """
    digest = None
    if read_manifest(path) is None:  # what answers are about is also known beside them
        beside = read_manifest(path.parent / "preferences")
        digest = None if beside is None else beside["about"].get("segments")
    needs = {OBSERVATION: 3, ACTION: 2, **(required or {})}
    data = load_tensordict(path, required=needs, digest=digest)
    data.auto_batch_size_(2)
    check_segments(data, path)
    return data


def load_preferences(
    path: Path, *, num_segments: int, segments: str | None = None, named: bool = True
) -> TensorDict:
    """Read preferences ``[M]`` and check that they belong to the segments at hand.

    Args:
        path: The folder.
        num_segments: Number of segments N.
        segments: Digest of the segments, which is compared with the one that was kept; None to
            compare nothing.
        named: Whether there must be ids of raters.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it is damaged, was changed, or compares other segments.
    """
    if read_manifest(path) is None and read_manifest(path.parent / "segments") is not None:
        raise ValueError(
            f"{path} has no manifest.json, but the segments beside it have one: it was removed, or "
            "these preferences are others; restore the folder, or collect it again"
        )
    ids = {RATER: 1} if named else {}
    data = load_tensordict(path, required={PAIR: 2, ANSWER: 1, **ids})
    manifest = read_manifest(path)
    kept = None if manifest is None else manifest["about"].get("segments")
    if kept is not None and segments is not None and kept != segments:
        raise ValueError(
            f"{path} compares other segments than those beside it (digest {segments}, expected "
            f"{kept}): one of the two was exchanged; restore the folder, or collect it again"
        )
    data.auto_batch_size_(1)
    return check_preferences(data, path, num_segments=num_segments)


def check_segments(data: TensorDictBase, path: Path) -> None:
    """Check that what was seen and done are numbers.

    Args:
        data: TensorDict ``[N, T]``.
        path: Where they are from, for the message.

    Raises:
        ValueError: If an observation or action is NaN or infinite.
    """
    for key in (OBSERVATION, ACTION):
        value = data[key]
        if value.is_floating_point() and not bool(value.isfinite().all()):
            number = int((~value.isfinite()).flatten(1).any(1).nonzero()[0])
            raise ValueError(
                f"{path} must hold finite numbers, but {key} of segment {number} is NaN or "
                "infinite; leave such segments out, or collect them again"
            )


def check_preferences(data: TensorDict, path: Path, *, num_segments: int) -> TensorDict:
    """Check that preferences belong to the segments at hand.

    Args:
        data: TensorDict ``[M]`` with ``pair`` and ``answer``.
        path: Where they are from, for the message.
        num_segments: Number of segments N.

    Returns:
        The same preferences.

    Raises:
        ValueError: If they are damaged, foreign, or refer to segments that do not exist.
    """
    pair, answer = data[PAIR], data[ANSWER]
    if pair.dtype != torch.int64 or pair.shape != (len(answer), 2) or not len(pair):
        raise ValueError(
            f"{path} must hold pairs of segment numbers, int64 of shape [M, 2], got {pair.dtype} "
            f"of shape {list(pair.shape)} for {len(answer)} answers; it is damaged or foreign"
        )
    if pair.min() < 0 or pair.max() >= num_segments:
        raise ValueError(
            f"{path} compares segments {int(pair.min())}..{int(pair.max())}, but there are "
            f"0..{num_segments - 1}; these preferences belong to other segments"
        )
    twice = int((pair[:, 0] == pair[:, 1]).sum())
    if twice:
        raise ValueError(
            f"{path} must hold pairs of two different segments, but {twice} compare a segment with "
            "itself; leave them out"
        )
    if answer.min() < 0 or answer.max() > max(Answer):
        raise ValueError(f"{path} holds answers outside 0..{max(Answer)}; it is damaged or foreign")
    _check_ids(data, path)
    return data


def _check_ids(data: TensorDict, path: Path) -> None:
    """Check who answered, in which group, and how surely."""
    for key, least, meaning in (
        (RATER, -1, "unknown (-1) or counted from 0"),
        (GROUP, 0, "from 0"),
    ):
        ids = data.get(key, None)
        name = key if isinstance(key, str) else ".".join(key)
        if ids is not None and (ids.is_floating_point() or ids.min() < least):
            raise ValueError(
                f"{path} must hold {name} as whole numbers, {meaning}, got {ids.min()} of "
                f"{ids.dtype}; it is damaged or foreign"
            )
    ranking = data.get(RANKING, None)
    if ranking is not None and (ranking.is_floating_point() or ranking.min() < -1):
        raise ValueError(
            f"{path} must hold ranking as whole numbers from 0, or -1 for a comparison, got "
            f"{ranking.min()} of {ranking.dtype}; it is damaged or foreign"
        )
    chance = data.get(CHANCE, None)
    if chance is not None and not ((chance >= 0) & (chance <= 1)).all():
        raise ValueError(f"{path} must hold chances from 0 to 1; it is damaged or foreign")
