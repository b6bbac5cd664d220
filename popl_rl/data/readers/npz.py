"""Pairs of segments in one npz file, as CPL publishes its data and as people keep theirs."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from tensordict import TensorDict

from popl_rl.data.readers.answers import read_answers
from popl_rl.data.readers.imported import Imported, Names
from popl_rl.data.readers.problems import Problems
from popl_rl.data.readers.table import check_sides, number_rankings, preferences_of
from popl_rl.keys import ACTION, MASK, OBSERVATION, RANKING, REWARD

__all__ = ["read_npz"]

_LABELS = ("answer", "label", "labels")
_FORMS = (
    "expected 'obs' and 'action' [segments, steps, ...] with 'pair' [M, 2] and 'answer' [M]; the "
    "same with a number for each segment ('rl_sum', 'reward_sum' or another named by score=), from "
    "which consecutive segments are compared; or 'obs_1 obs_2 action_1 action_2' [M, steps, ...] "
    "with 'label' [M]"
)


def read_npz(path: Path, *, score: str | None = None, one_sided: bool = False) -> Imported:
    """Read segments and preferences from an npz file.

    Three forms are known. (1) ``obs``, ``action`` ``[N, T, ...]``, ``pair`` ``[M, 2]`` and
    ``answer`` ``[M]``. (2) ``obs``, ``action`` and a number for each segment, as CPL (arXiv
    2310.13639) publishes: segments 2i and 2i + 1 are compared, the larger number is preferred, and
    equal ones are ties. (3) CPL's older ``obs_1 obs_2 action_1 action_2`` with ``label``, 1 (or
    near it) where the second is preferred. ``rater``, ``condition``, ``chance`` (soft labels
    beside codes), ``ranking`` ``[M]`` (which one each is part of, of this rater; -1 for a mere
    comparison) and ``mask`` ``[N, T]`` may be there.

    Args:
        path: The file.
        score: Name of the number for each segment, in form (2).
        one_sided: Accept that all answers prefer the same side.

    Raises:
        ValueError: Naming rows, counted from 0, if something makes no sense.
        FileNotFoundError: If there is none.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, AttributeError) as error:
        raise ValueError(f"{path} is not readable as npz ({error})") from error
    problems = Problems(path, first=0)
    if "obs_1" in arrays:
        steps, pair = _joined(arrays, path)
    else:
        steps, pair = _shared(arrays, path)
    segments = _segments(steps, problems)
    if not len(pair) or pair.min() < 0 or pair.max() >= len(segments):
        wrong = ((pair < 0) | (pair >= len(segments))).any(1)
        problems.add(wrong, f"'pair' must name segments in 0..{len(segments) - 1}")
        if not len(pair):
            problems.add_text("there are no pairs")
    problems.check()
    answer, chance = _answers(arrays, pair, score, problems)
    problems.check()
    if not one_sided:
        check_sides(answer, path)
    columns = [_column(arrays, name, len(pair), path) for name in ("rater", "condition")]
    preferences, raters, conditions = preferences_of(pair, answer, chance, *columns)
    ranking = _column(arrays, "ranking", len(pair), path)
    if ranking is not None:
        dtype = arrays["ranking"].dtype
        if dtype.kind not in "iu":
            raise ValueError(
                f"{path}: 'ranking' must be whole numbers, -1 for a comparison, got {dtype}"
            )
        preferences[RANKING] = number_rankings(ranking, columns[0])
    named = [str(name) for name in arrays.get("conditions", [])]
    if named and conditions:
        conditions = [named[int(number)] for number in conditions]
    return Imported(segments, preferences, Names([], raters, conditions))


def _need(arrays: dict[str, Any], names: tuple[str, ...], path: Path) -> Any:
    found = next((arrays[name] for name in names if name in arrays), None)
    if found is None:
        raise ValueError(
            f"{path} must hold {' or '.join(map(repr, names))}, got {sorted(arrays)}; {_FORMS}"
        )
    return found


def _joined(arrays: dict[str, Any], path: Path) -> tuple[dict[str, Any], npt.NDArray[np.int64]]:
    """The form in which each pair brings its own segments."""
    steps = {}
    for name in ("obs", "action", "reward", "mask"):
        if name in ("obs", "action") or f"{name}_1" in arrays:
            sides = [_need(arrays, (f"{name}_{side}",), path) for side in (1, 2)]
            if sides[0].shape != sides[1].shape:
                shapes = " and ".join(str(list(side.shape)) for side in sides)
                raise ValueError(f"{path}: '{name}_1' and '{name}_2' differ in shape: {shapes}")
            steps[name] = np.concatenate(sides)
    count = len(steps["obs"]) // 2
    return steps, np.stack([np.arange(count), count + np.arange(count)], 1)


def _shared(arrays: dict[str, Any], path: Path) -> tuple[dict[str, Any], npt.NDArray[np.int64]]:
    steps = {"obs": _need(arrays, ("obs", "observation"), path)}
    steps["action"] = _need(arrays, ("action", "actions"), path)
    steps |= {name: arrays[name] for name in ("reward", "mask") if name in arrays}
    if "pair" in arrays:
        pair = np.asarray(arrays["pair"])
        if pair.ndim != 2 or pair.shape[1] != 2 or pair.dtype.kind not in "iu":
            raise ValueError(
                f"{path}: 'pair' must be whole numbers of shape [M, 2], got {pair.dtype} of shape "
                f"{list(pair.shape)}"
            )
        return steps, pair.astype(np.int64)
    return steps, np.arange(len(steps["obs"]) // 2 * 2).reshape(-1, 2)


def _segments(steps: dict[str, Any], problems: Problems) -> TensorDict:
    observation, action = np.asarray(steps["obs"]), np.asarray(steps["action"])
    if observation.ndim != 3 or action.shape[:2] != observation.shape[:2]:
        problems.add_text(
            "'obs' must have shape [segments, steps, features] and 'action' the same first two "
            f"axes, got {list(observation.shape)} and {list(action.shape)}"
        )
        problems.check()
    data = {
        OBSERVATION: torch.from_numpy(observation.astype(np.float32)),
        ACTION: torch.from_numpy(
            action.astype(np.float32 if action.dtype.kind == "f" else np.int64)
        ),
    }
    there = np.ones(observation.shape[:2], bool)
    if "mask" in steps:
        there = np.asarray(steps["mask"], bool)
        data[MASK] = torch.from_numpy(there)
        problems.add(~there.any(1), "a segment needs a step that the mask keeps")
    if "reward" in steps and np.asarray(steps["reward"]).shape == there.shape:
        data[REWARD] = torch.from_numpy(np.asarray(steps["reward"], np.float32))
    wrong = ~np.isfinite(observation).all(-1)
    if action.dtype.kind == "f":
        wrong |= ~np.isfinite(action).reshape(*action.shape[:2], -1).all(-1)
    problems.add((wrong & there).any(1), "observations and actions must be finite numbers")
    data[OBSERVATION] = data[OBSERVATION].nan_to_num()
    return TensorDict(data, list(there.shape))


def _answers(
    arrays: dict[str, Any],
    pair: npt.NDArray[np.int64],
    score: str | None,
    problems: Problems,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32] | None]:
    label = next((arrays[name] for name in _LABELS if name in arrays), None)
    if label is not None and score is None:
        label = np.asarray(label)
        if label.shape != (len(pair),):
            problems.add_text(f"labels must have shape [{len(pair)}], got {list(label.shape)}")
            problems.check()
        code, chance = read_answers(pd.Series(label), problems)
        soft = arrays.get("chance")
        return code, chance if soft is None else np.asarray(soft, np.float32)
    names = ("rl_sum", "reward_sum", "rl_dir", "score") if score is None else (score,)
    value = np.asarray(_need(arrays, names, problems.path), float)
    while value.ndim > 1:
        value = value.sum(-1)
    problems.add(~np.isfinite(value), "the number of a segment must be finite")
    problems.check()
    left, right = value[pair[:, 0]], value[pair[:, 1]]
    return np.where(left == right, 2, (right > left).astype(np.int64)), None


def _column(arrays: dict[str, Any], name: str, count: int, path: Path) -> pd.Series | None:
    if name not in arrays:
        return None
    values = np.asarray(arrays[name])
    if values.shape != (count,):
        raise ValueError(f"{path}: {name!r} must have shape [{count}], got {list(values.shape)}")
    column = pd.Series(values)
    # How arrays, which know no missing values, say that somebody is unknown.
    return column.where(column != (-1 if values.dtype.kind in "iu" else ""))
