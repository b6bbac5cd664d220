"""Preferences as other programs read them: our folder, csv, npz. Rater ids are always kept."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict

from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.saved import (
    load_preferences,
    load_segments,
    save_preferences,
    segments_digest,
)
from popl_rl.keys import (
    ACTION,
    ANSWER,
    CHANCE,
    CONDITION,
    MASK,
    OBSERVATION,
    PAIR,
    RANKING,
    RATER,
    REWARD,
)
from popl_rl.manifest import read_sealed, sealed
from popl_rl.storage import read_manifest, save_tensordict, write_json, written_beside

__all__ = ["read_folder", "write_csv", "write_folder", "write_npz"]

_NAMES = "names.json"


def write_folder(data: Imported, path: Path, *, about: Mapping[str, Any] | None = None) -> None:
    """Write a folder that ``data.load=`` reads: segments, preferences and ``names.json``.

    Args:
        data: What to write.
        path: The folder to be.
        about: What else the preferences' manifest says, such as the id of a run.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    with written_beside(path) as beside:
        save_tensordict(data.segments, beside / "segments")
        digest = segments_digest(beside / "segments", data.segments)
        names = sealed(data.names._asdict())
        kept = {**(about or {}), "names": names["seal"]}
        save_preferences(data.preferences, beside / "preferences", segments=digest, about=kept)
        write_json(beside / _NAMES, names)


def read_folder(path: Path) -> Imported:
    """Read segments and preferences from a folder of ours, with names if there are any.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it is truncated, damaged, or something else.
    """
    segments = load_segments(path / "segments")
    preferences = load_preferences(
        path / "preferences",
        num_segments=len(segments),
        segments=segments_digest(path / "segments", segments),
        named=False,
    )
    return Imported(segments, preferences, _read_names(path))


def _read_names(path: Path) -> Names:
    """Names of items, raters and conditions, if there are any."""
    manifest = read_manifest(path / "preferences")
    kept = None if manifest is None else manifest["about"].get("names")
    cure = "import the data again"
    if kept is None and not (path / _NAMES).is_file():
        return Names()
    try:
        told = read_sealed(path / _NAMES, cure=cure)
        told.pop("seal", None)  # of an earlier version
        if kept not in (None, sealed(told)["seal"]):
            raise ValueError("they are those of other preferences")
        return Names(**told)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(
            f"{path / _NAMES} is not readable as names of items, raters and conditions "
            f"({error}); {cure}"
        ) from error


def write_csv(data: Imported, path: Path) -> None:
    """Write ``comparisons.csv`` and, of items, ``items.csv``; of segments, ``segments.csv``.

    What is written can be read again, see `popl_rl.data.readers.table.read_table`.

    Args:
        data: What to write.
        path: The folder to be.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    segments, preferences, names = data
    ids = names.items or [str(number) for number in range(len(segments))]
    columns: dict[str, object] = {}
    if RATER in preferences.keys():  # noqa: SIM118 - not a dict
        columns["rater"] = _named(preferences[RATER], names.raters)
    for side, column in zip(("first", "second"), preferences[PAIR].T, strict=True):
        columns[side] = [ids[number] for number in column.tolist()]
    columns["answer"] = _answers(preferences)
    if CONDITION in preferences.keys(True):
        columns["condition"] = _named(preferences[CONDITION], names.conditions)
    if RANKING in preferences.keys():  # noqa: SIM118
        columns["ranking"] = _named(preferences[RANKING], [])
    with written_beside(path) as beside:
        pd.DataFrame(columns).to_csv(beside / "comparisons.csv", index=False)
        if segments.batch_size[1] == 1:
            _items(data, ids).to_csv(beside / "items.csv", index=False)
        else:
            _steps(data, ids).to_csv(beside / "segments.csv", index=False)


def write_npz(data: Imported, path: Path) -> None:
    """Write one npz file that `popl_rl.data.readers.npz.read_npz` reads.

    Args:
        data: What to write.
        path: The file to be.

    Raises:
        FileExistsError: If ``path`` exists.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or choose another path")
    segments, preferences, names = data
    arrays = {
        "obs": segments[OBSERVATION].numpy(),
        "action": segments[ACTION].numpy(),
        "pair": preferences[PAIR].numpy(),
        "answer": preferences[ANSWER].numpy(),
    }
    if CHANCE in preferences.keys():  # noqa: SIM118 - not a dict
        arrays["chance"] = preferences[CHANCE].numpy()
    if RANKING in preferences.keys():  # noqa: SIM118
        arrays["ranking"] = preferences[RANKING].numpy()
    arrays |= {
        str(key): segments[key].numpy()
        for key in (MASK, REWARD)
        if key in segments.keys()  # noqa: SIM118
    }
    for key, name, known in (
        (RATER, "rater", names.raters),
        (CONDITION, "condition", names.conditions),
    ):
        if key in preferences.keys(True):
            arrays[name] = np.array(_named(preferences[key], known), str)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.tmp.npz")
    np.savez_compressed(beside, **arrays)  # type: ignore[arg-type]
    beside.replace(path)


def _named(number: torch.Tensor, names: list[str]) -> list[str]:
    """Names of raters or conditions; empty text where unknown."""
    return ["" if code < 0 else names[code] if names else str(code) for code in number.tolist()]


def _answers(preferences: TensorDict) -> list[object]:
    if CHANCE not in preferences.keys():  # noqa: SIM118 - not a dict
        return list(preferences[ANSWER].tolist())
    codes, chances = preferences[ANSWER].tolist(), preferences[CHANCE].tolist()
    return ["skip" if code == 3 else chance for code, chance in zip(codes, chances, strict=True)]


def _items(data: Imported, ids: list[str]) -> pd.DataFrame:
    columns: dict[str, object] = {"item": ids}
    if data.names.texts:
        columns["text"] = data.names.texts
    features = data.segments[OBSERVATION][:, 0].numpy()
    return pd.concat(
        [
            pd.DataFrame(columns),
            pd.DataFrame(features, columns=[f"x{i}" for i in range(features.shape[1])]),
        ],
        axis=1,
    )


def _steps(data: Imported, ids: list[str]) -> pd.DataFrame:
    segments = data.segments
    count, length = segments.batch_size
    there = np.ones((count, length), bool)
    if MASK in segments.keys():  # noqa: SIM118 - not a dict
        there = segments[MASK].numpy()
    segment, step = np.nonzero(there)
    observation = segments[OBSERVATION].numpy()[segment, step]
    action = segments[ACTION].numpy()[segment, step]
    columns: dict[str, object] = {"segment": np.array(ids)[segment], "step": step}
    if action.ndim == 1:
        columns["action"] = action
    else:
        columns |= {f"action_{i}": action[:, i] for i in range(action.shape[1])}
    columns |= {f"x{i}": observation[:, i] for i in range(observation.shape[1])}
    return pd.DataFrame(columns)
