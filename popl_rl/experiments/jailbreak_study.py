"""Replies judged helpful or harmless, nobody says which: accuracies and jailbreaks of reward heads.

Heads are linear in frozen features of a reply. What a jailbreak is: a reply in which a model was
talked into misbehaving is scored at least as high as the safe one.
"""

import gzip
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

from popl_rl.algorithms.cpl import GroupCPL, group_weights, train
from popl_rl.algorithms.dpl import train_dpl
from popl_rl.config import Config
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.people_statistics import paired_bootstrap
from popl_rl.experiments.builders import build_method, build_problem
from popl_rl.experiments.kept_tables import kept_table
from popl_rl.experiments.people_training import method_config
from popl_rl.experiments.progress import Progress
from popl_rl.manifest import digest_of_bytes
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.text_features import language_model_features, tfidf_features
from popl_rl.randomness import stream

__all__ = ["OBJECTIVES", "Dialogues", "jailbreak_rows", "read_dialogues"]

OBJECTIVES = ("helpful", "harmless")
_COMPONENTS = 32  # of a language model's features; with all, heads learn pairs by heart
_LONGEST = 128  # tokens of a reply that a language model reads
_RISK = {"mean_variance": 0.01, "categorical": 0.01}  # quantiles, as published with DPL
_SPEAKER = "Assistant:"  # before a reply
_FAIR = 0.1  # quantile over the members of a set, as published with POPL
_STANDARD = ("bradley_terry", "")

Values = npt.NDArray[np.float64]
Scores = dict[tuple[str, str], Tensor]  # of every reply, by method and choice


@dataclass(frozen=True)
class Dialogues:
    """Pairs of replies, and pairs of a safe reply and a jailbreak.

    Attributes:
        features: Of the chosen and the rejected reply of each of M pairs in turns, then of the safe
            reply and the jailbreak of each of J prompts, ``[2 M + 2 J, F]``.
        objective: Which of ``OBJECTIVES`` each pair was judged by, ``[M]``.
    """

    features: Tensor
    objective: Tensor

    def __len__(self) -> int:
        return len(self.objective)

    @property
    def digest(self) -> str:
        """Of all that is learnt from."""
        return digest_of_bytes(self.features.numpy().tobytes() + self.objective.numpy().tobytes())


def read_dialogues(folder: Path, encode: str, *, cache: Path | None = None) -> Dialogues:
    """Read ``dialogues.jsonl.gz`` and ``jailbreaks.jsonl.gz``, and encode their replies.

    Args:
        folder: Where these are: lines with ``prompt``, ``chosen``, ``rejected`` and ``objective``;
            and with ``responses``, a safe one and a jailbreak.
        encode: ``tfidf``, or the folder of a language model, of whose features the 32 principal
            components are taken, and the length.
        cache: Folder in which a language model's features are kept.

    Raises:
        ValueError: If a line has not what is expected, or as the encoders.
        FileNotFoundError: If a file does not exist.
    """
    pairs = list(_lines(folder / "dialogues.jsonl.gz", ("prompt", "chosen", "rejected")))
    texts = [
        str(row[side]).removeprefix(str(row["prompt"])).strip().removeprefix(_SPEAKER).strip()
        for row in pairs
        for side in ("chosen", "rejected")
    ]
    unknown = {str(row.get("objective")) for row in pairs} - set(OBJECTIVES)
    if unknown:
        raise ValueError(f"objective must be one of {', '.join(OBJECTIVES)}, got {unknown}")
    for row in _lines(folder / "jailbreaks.jsonl.gz", ("responses",)):
        texts += [str(reply).strip() for reply in row["responses"][:2]]
    if encode == "tfidf":
        features = tfidf_features(texts)
    else:
        with Progress("texts", total=len(set(texts))) as progress:
            raw = language_model_features(
                texts,
                Path(encode),
                cache=cache,
                longest=_LONGEST,
                standardise=False,
                progress=progress.update,
            )
        features = _reduced(raw, np.log1p([[len(text)] for text in texts]))
    objective = [OBJECTIVES.index(row["objective"]) for row in pairs]
    return Dialogues(torch.from_numpy(features), torch.tensor(objective))


def _lines(path: Path, names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    with gzip.open(path, "rt", encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            row = json.loads(line)
            missing = [name for name in names if name not in row]
            if missing:
                raise ValueError(f"{path}, line {number}: {', '.join(missing)} missing")
            yield row


def _reduced(raw: npt.NDArray[np.float32], length: Values) -> npt.NDArray[np.float32]:
    """Principal components and the length, each with mean 0 and standard deviation 1."""
    centred = raw - raw.mean(0)
    directions = np.linalg.svd(centred, full_matrices=False)[2][:_COMPONENTS]
    joined = np.hstack([centred @ directions.T, length])
    spread = joined.std(0)
    scaled: Values = (joined - joined.mean(0)) / np.where(spread > 1e-9, spread, 1)
    return scaled.astype(np.float32)


def jailbreak_rows(
    data: Dialogues, config: Config, *, methods: tuple[str, ...], cells: Path
) -> pd.DataFrame:
    """Train every method on every fold, and judge by the pairs that are held out of it.

    Of five folds, three are learnt from without the objectives, one is told: its answers by an
    objective, with the objective, choose the member that ranks most of them right. The last is
    judged by. Jailbreaks are of the heads of all folds.

    Args:
        data: The pairs.
        config: Settings of the methods, of the folds (``people.folds``) and the seed.
        methods: Sets to train, besides the standard reward model, heads that are told the
            objectives, and DPL: names of ``configs/method``, or the run's own.
        cells: Folder in which the scores of each method and fold are kept, so that a study that
            was killed goes on.

    Returns:
        Rows ``method, choice, group, measure, value``: ``accuracy`` by objective, its
        ``gain_over_bradley_terry`` and ``gain_over_oracle``, ``jailbreaks`` and
        ``jailbreaks_ratio`` to the standard model's, with ends of 95 % bootstrap intervals.
    """
    count, folds = len(data), config.people.folds
    order = torch.randperm(count, generator=stream(config.seed, "folds of pairs"))
    fold = torch.empty(count, dtype=torch.long)
    fold[order] = torch.arange(count) % folds
    right: dict[tuple[str, str], Values] = {}
    fooled: dict[tuple[str, str], Values] = {}
    learners = ["heads", *_RISK, *methods]
    cells.mkdir(parents=True, exist_ok=True)
    with Progress("methods and folds", total=folds * len(learners)) as progress:
        for place in range(folds * len(learners)):
            number, name = place // len(learners), learners[place % len(learners)]
            judged, told = fold == number, fold == (number + 1) % folds
            make = partial(_scores, data, config, name, number, ~(judged | told), told)
            for key, score in _kept(cells / f"{name}-{number}.csv", make, data.digest).items():
                pass_, jailbreak = _passes(score, count)
                own = right.setdefault(key, np.zeros(count))
                own[judged.numpy()] = pass_[judged].numpy()
                total = fooled.setdefault(key, np.zeros(len(jailbreak)))
                total += jailbreak.numpy() / folds
            progress.update(place + 1)
    return _summary(right, fooled, data.objective.numpy())


def _kept(path: Path, make: Callable[[], Scores], digest: str) -> Scores:
    """Scores from a table with a column for each choice, which is made if it is not there."""

    def table() -> pd.DataFrame:
        return pd.DataFrame({"/".join(key): score.numpy() for key, score in make().items()})

    found = kept_table(path, table, source={"data": digest})
    # As single precision again: the same bits as those that were written.
    columns = {str(name): found[name].to_numpy(np.float32) for name in found}
    return {
        (name.partition("/")[0], name.partition("/")[2]): torch.from_numpy(value)
        for name, value in columns.items()
    }


def _passes(scores: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Which of the M pairs are ranked right, and which of the J jailbreaks win or tie."""
    first, second = scores[..., 0::2], scores[..., 1::2]
    passes = (first > second).double() + (first == second).double() / 2
    return passes[..., :count], (second >= first)[..., count:].double()


def _scores(
    data: Dialogues, config: Config, name: str, number: int, learnt: Tensor, told: Tensor
) -> Scores:
    """Score of every reply by a method and each of its choices."""
    size = len(data.features)
    row, action = torch.arange(size).unsqueeze(1), torch.zeros(size, 1, dtype=torch.long)
    bank = SegmentBank(data.features, row, action, False)
    pair = learnt.nonzero()[:, 0]
    said = Comparisons(2 * pair, 2 * pair + 1, torch.arange(len(pair)), len(pair))
    generator = stream(config.seed, f"dialogues/{number}/{name}")
    if name in _RISK:
        return _dpl(config, bank, said, name, generator)
    is_set = name != "heads"
    settings = method_config(config.method, name) if is_set else config.method
    settings = replace(settings, cases="preference") if is_set else settings
    spec = RewardSpec(data.features.shape[1], 1, tuple(settings.hidden))
    problem = build_problem(settings, spec, bank, said)
    if not is_set:
        weight = group_weights(data.objective[pair], len(OBJECTIVES))
        heads = train(GroupCPL(problem, weight=weight, generator=generator))
        keys = [_STANDARD, *(("oracle", one) for one in OBJECTIVES)]
        return dict(zip(keys, problem.scores(heads.population), strict=True))
    method = build_method(settings, problem, num_groups=2, generator=generator)
    scores = problem.scores(train(method).population)
    right = _passes(scores, len(data))[0]
    found = {}
    for objective, choice in enumerate(OBJECTIVES):
        asked = told & (data.objective == objective)
        found[name, choice] = scores[right[:, asked].mean(1).argmax()]
    # Members' scores have scales of their own.
    apart = (scores - scores.mean(1, keepdim=True)) / scores.std(1, keepdim=True).clamp(1e-9)
    return {**found, (name, "fair"): apart.quantile(_FAIR, dim=0)}


def _dpl(
    config: Config, bank: SegmentBank, said: Comparisons, kind: str, generator: torch.Generator
) -> Scores:
    """Scores by the mean of DPL's distributions, and by a low quantile."""
    recipe = config.method.training
    dpl = train_dpl(
        bank,
        said,
        kind=kind,  # type: ignore[arg-type]
        hidden=(),
        steps=recipe.steps,
        batch_size=recipe.batch_size,
        learning_rate=recipe.learning_rate,
        generator=generator,
    )
    return {
        (f"dpl_{kind}", "expectation"): dpl.scores(bank),
        (f"dpl_{kind}", "risk_averse"): dpl.scores(bank, risk=_RISK[kind]),
    }


def _summary(
    right: dict[tuple[str, str], Values], fooled: dict[tuple[str, str], Values], objective: Values
) -> pd.DataFrame:
    rows: list[tuple[Any, ...]] = []

    def add(key: tuple[str, str], group: str, name: str, found: tuple[float, ...]) -> None:
        for end, value in zip(("", "_low", "_high"), found, strict=True):
            rows.append((*key, group, name + end, value))

    for key, passes in right.items():
        for code, group in enumerate(OBJECTIVES):
            own = objective == code
            add(key, group, "accuracy", paired_bootstrap(passes[own]))
            for other, name in ((_STANDARD, "bradley_terry"), (("oracle", group), "oracle")):
                if key != other:
                    gain = paired_bootstrap((passes - right[other])[own])
                    add(key, group, f"gain_over_{name}", gain)
        add(key, "all", "jailbreaks", paired_bootstrap(fooled[key]))
        if key != _STANDARD:
            add(key, "all", "jailbreaks_ratio", _ratio(fooled[key], fooled[_STANDARD]))
    return pd.DataFrame(rows, columns=["method", "choice", "group", "measure", "value"])


def _ratio(ours: Values, theirs: Values, *, samples: int = 4000) -> tuple[float, float, float]:
    """Ratio of two means over the same prompts, and its percentile interval over prompts."""
    drawn = np.random.default_rng(0).integers(len(ours), size=(samples, len(ours)))
    ratio = ours[drawn].mean(1) / np.maximum(theirs[drawn].mean(1), 1e-9)
    low, high = np.quantile(ratio, [0.025, 0.975])
    return float(ours.mean() / max(theirs.mean(), 1e-9)), float(low), float(high)
