"""From accuracies of single people to rows: means, intervals, who gains, who is served worst."""

from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

__all__ = ["PERSON_COLUMNS", "compare", "paired_bootstrap", "summarise_people"]

#: Columns of ``people.csv``: a row for each person, method, choice and number of answers.
PERSON_COLUMNS = [
    "method",
    "choice",
    "fold",
    "person",
    "group",
    "answers",
    "accuracy",
    "log_likelihood",
]

_DECILE = 0.1
_MANY = 5000  # people of whom the bootstrap's limit is taken

Values = npt.NDArray[np.float64]


def paired_bootstrap(
    difference: Values, *, samples: int = 4000, seed: int = 0, level: float = 0.95
) -> tuple[float, float, float]:
    """Mean of paired differences and its percentile interval over people (Efron, 1979).

    Of more than 5000 people the interval is that of the normal distribution to which the bootstrap
    converges: the two differ by less than the error of the resampling itself, which would take
    longer than learning does.

    Args:
        difference: One number for each person, ``[P]``.
        samples: Resamples of the people.
        seed: Seed of the resampling.
        level: Confidence of the interval.

    Returns:
        Mean, lower and upper end; the ends are NaN with fewer than two people.
    """
    if not len(difference):
        return float("nan"), float("nan"), float("nan")
    mean = float(difference.mean())
    if len(difference) < 2:
        return mean, float("nan"), float("nan")
    if len(difference) > _MANY:
        half = (
            NormalDist().inv_cdf((1 + level) / 2) * float(difference.std()) / len(difference) ** 0.5
        )
        return mean, mean - half, mean + half
    generator = np.random.default_rng(seed)
    means = np.empty(samples)
    for start in range(0, samples, 200):  # a matrix of all would not fit with many people
        size = (min(200, samples - start), len(difference))
        drawn = generator.integers(len(difference), size=size)
        means[start : start + 200] = difference[drawn].mean(1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return mean, float(low), float(high)


def compare(ours: Values, theirs: Values, *, seed: int = 0) -> dict[str, float]:
    """What one method is to people beside another.

    Args:
        ours: Accuracy of each person, ``[P]``.
        theirs: The same people's with the other method, ``[P]``.
        seed: Seed of the bootstrap.

    Returns:
        ``gain`` with ``gain_low`` and ``gain_high`` (paired bootstrap over people), and the shares
        of people who ``gain_share`` and ``loss_share``.
    """
    difference = ours - theirs
    mean, low, high = paired_bootstrap(difference, seed=seed)
    return {
        "gain": mean,
        "gain_low": low,
        "gain_high": high,
        "gain_share": float((difference > 1e-9).mean()),
        "loss_share": float((difference < -1e-9).mean()),
    }


def summarise_people(
    people: pd.DataFrame, *, references: Sequence[tuple[str, str]] = (), seed: int = 0
) -> pd.DataFrame:
    """Rows ``method, choice, group, measure, value`` over all people, and over those of each group.

    Measures after K answers are ``people@K`` (how many there are), ``accuracy@K`` and
    ``log_likelihood@K`` with the ends of their intervals (``_low``, ``_high``), and
    ``worst_decile@K``, the mean accuracy of the tenth that is served worst. Against each reference
    ``gain_over_<method>@K`` and so on, see `compare`, and ``likelihood_gain_over_<method>@K``
    with its ends.

    Args:
        people: Rows with the columns `PERSON_COLUMNS`; folds and people are averaged over.
        references: Method and choice of what the others are compared with.
        seed: Seed of the bootstrap.
    """
    rows: list[tuple[str, str, str, str, float]] = []
    groups = [("all", people)]
    named = people[people["group"] != ""]
    groups += [(str(name), part) for name, part in named.groupby("group", sort=True)]
    for group, part in groups:
        tables = _tables(part)
        for (method, choice, answers), table in tables.items():
            measures = _alone(table, seed)
            for reference in references:
                other = tables.get((*reference, answers))
                # One hypothesis for all is the same whatever was answered.
                other = tables.get((*reference, 0)) if other is None else other
                if other is None or reference == (method, choice):
                    continue
                measures |= _beside(table, other, _reference_name(reference), seed)
            rows += [
                (method, choice, group, f"{name}@{answers}", value)
                for name, value in measures.items()
            ]
    return pd.DataFrame(rows, columns=["method", "choice", "group", "measure", "value"])


def _reference_name(reference: tuple[str, str]) -> str:
    method, choice = reference
    return f"{method}_{choice}" if choice else method


def _tables(people: pd.DataFrame) -> dict[tuple[str, str, int], pd.DataFrame]:
    found: dict[tuple[str, str, int], pd.DataFrame] = {}
    keys: Any = ["method", "choice", "answers"]
    for key, part in people.groupby(keys, sort=False):
        method, choice, answers = key
        values = part.groupby("person")[["accuracy", "log_likelihood"]].mean()
        found[str(method), str(choice), int(answers)] = values
    return found


def _alone(table: pd.DataFrame, seed: int) -> dict[str, float]:
    accuracy = table["accuracy"].to_numpy(float)
    worst = np.sort(accuracy)[: max(1, round(_DECILE * len(accuracy)))]
    found = {"people": float(len(accuracy)), "worst_decile": float(worst.mean())}
    for name in ("accuracy", "log_likelihood"):
        mean, low, high = paired_bootstrap(table[name].to_numpy(float), seed=seed)
        found |= {name: mean, f"{name}_low": low, f"{name}_high": high}
    return found


def _beside(table: pd.DataFrame, other: pd.DataFrame, name: str, seed: int) -> Mapping[str, float]:
    both = table.join(other.add_suffix("_other"), how="inner")
    ours, theirs = both["accuracy"].to_numpy(float), both["accuracy_other"].to_numpy(float)
    found = {}
    for measure, value in compare(ours, theirs, seed=seed).items():
        what, _, end = measure.partition("_")
        ending = f"_{end}" if end else ""
        found[f"{what}_over_{name}{ending}"] = value
    likely = (both["log_likelihood"] - both["log_likelihood_other"]).to_numpy(float)
    ends = paired_bootstrap(likely, seed=seed)
    for ending, value in zip(("", "_low", "_high"), ends, strict=True):
        found[f"likelihood_gain_over_{name}{ending}"] = value
    return found
