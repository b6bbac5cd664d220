"""What there is in people's preferences, in one screen."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from popl_rl.data.readers.imported import Imported
from popl_rl.keys import ANSWER, CHANCE, CONDITION, MASK, OBSERVATION, PAIR, RATER, Answer

__all__ = ["Summary", "summarise"]

_EDGES = (1, 2, 5, 10, 20, 50, 100, 1000)
_BAR = 24


@dataclass(frozen=True)
class Summary:
    """What a reader found.

    Attributes:
        segments: Number of segments, or items.
        steps: Steps of the shortest and of the longest.
        features: Length of an observation.
        texts: Whether they are texts.
        answers: Number of answers.
        first: Strict answers for the first.
        ties: Ties.
        skips: Skips.
        soft: Answers that are soft labels between 0 and 1.
        raters: Raters by number of answers: how many gave so many, ``{answers: raters}``.
        unknown: Answers of nobody known.
        conditions: Answers in each condition.
        shared: Pairs that several people, or one person several times, judged.
        agreement: How often two strict answers on such a pair agree; NaN if there are none.
        duplicates: Answers that repeat an earlier one of the same person on the same pair.
        contradictions: Pairs on which a person gave different strict answers.
        unused: Segments that nobody was asked about.
    """

    segments: int
    steps: tuple[int, int]
    features: int
    texts: bool
    answers: int
    first: int
    ties: int
    skips: int
    soft: int
    raters: dict[int, int]
    unknown: int
    conditions: dict[str, int]
    shared: int
    agreement: float
    duplicates: int
    contradictions: int
    unused: int

    def lines(self) -> list[str]:
        """The summary as text, a screen of it."""
        low, high = self.steps
        what = "texts" if self.texts else "segments" if high > 1 else "items"
        strict = self.answers - self.ties - self.skips
        steps = f" of {high} steps" if high > 1 else ""
        steps = f" of {low} to {high} steps" if low < high else steps
        lines = [
            f"{self.segments} {what}{steps}, {self.features} features; {self.unused} never asked "
            "about",
            f"{self.answers} answers: {strict} strict ({_share(self.first, strict)} for the "
            f"first), {self.ties} ties, {self.skips} skips"
            + (f", {self.soft} soft labels" if self.soft else ""),
        ]
        count = sum(self.raters.values())
        if count:
            total = sum(number * people for number, people in self.raters.items())
            ordered = np.repeat(list(self.raters), list(self.raters.values()))
            lines.append(
                f"{count} raters, {total / count:.1f} answers each (median "
                f"{np.median(ordered):g}, most {ordered.max()}); {self.unknown} answers of nobody "
                "known"
            )
            lines += self._histogram(ordered)
        else:
            lines.append("nobody kept who answered: every answer is a case of its own")
        for name, number in self.conditions.items():
            lines.append(f"  condition {name}: {number} answers")
        agreement = "" if np.isnan(self.agreement) else f", agreement {self.agreement:.2f}"
        lines.append(f"{self.shared} pairs judged more than once{agreement}")
        lines.append(
            f"{self.duplicates} repeated answers, {self.contradictions} pairs on which a rater "
            "contradicts itself"
        )
        return lines

    def _histogram(self, answers: np.ndarray) -> list[str]:  # type: ignore[type-arg]
        counts = []
        for low, high in zip(_EDGES, [*_EDGES[1:], np.inf], strict=True):
            inside = int(((answers >= low) & (answers < high)).sum())
            label = f"{low}" if high == low + 1 else f"{low}-{high - 1:g}"
            counts.append((label if high < np.inf else f"{low}+", inside))
        most = max(number for _, number in counts)
        return [
            f"  {label:>8} answers {'█' * round(_BAR * number / most):<{_BAR}} {number}"
            for label, number in counts
            if number
        ]


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.0%}" if whole else "none"


def summarise(data: Imported) -> Summary:
    """Look through what a reader found.

    Args:
        data: Segments, preferences and names.
    """
    segments, preferences, names = data
    pair, answer = preferences[PAIR].numpy(), preferences[ANSWER].numpy()
    keys = preferences.keys(True)
    who = preferences[RATER].numpy() if RATER in keys else np.full(len(pair), -1)
    answers_of = pd.Series(who[who >= 0]).value_counts().value_counts().sort_index()
    conditions: dict[str, int] = {}
    if CONDITION in keys:
        codes = pd.Series(preferences[CONDITION].numpy())
        for code, number in codes[codes >= 0].value_counts(sort=False).items():
            named = names.conditions[int(code)] if names.conditions else str(code)  # type: ignore[call-overload]
            conditions[named] = int(number)
    soft = 0
    if CHANCE in keys:
        chance = preferences[CHANCE].numpy()
        soft = int(((chance % 1 != 0) & (answer <= Answer.TIE)).sum())
    lengths = np.full(len(segments), segments.batch_size[1])
    if MASK in segments.keys():  # noqa: SIM118 - not a dict
        lengths = segments[MASK].sum(1).numpy()
    shared, agreement, duplicates, contradictions = _repeats(pair, answer, who)
    return Summary(
        segments=len(segments),
        steps=(int(lengths.min()), int(lengths.max())),
        features=segments[OBSERVATION].shape[-1],
        texts=bool(names.texts),
        answers=len(pair),
        first=int((answer == Answer.FIRST).sum()),
        ties=int((answer == Answer.TIE).sum()),
        skips=int((answer == Answer.SKIP).sum()),
        soft=soft,
        raters={int(number): int(people) for number, people in answers_of.items()},  # type: ignore[call-overload]
        unknown=int((who < 0).sum()),
        conditions=conditions,
        shared=shared,
        agreement=agreement,
        duplicates=duplicates,
        contradictions=contradictions,
        unused=len(segments) - len(np.unique(pair)),
    )


def _repeats(
    pair: np.ndarray,  # type: ignore[type-arg]
    answer: np.ndarray,  # type: ignore[type-arg]
    who: np.ndarray,  # type: ignore[type-arg]
) -> tuple[int, float, int, int]:
    """Pairs judged more than once, agreement on them, repeated answers, contradictions."""
    low, high = pair.min(1), pair.max(1)
    # Which of the two was preferred, whatever the order in which they were shown.
    said = np.where(answer <= Answer.SECOND, answer ^ (pair[:, 0] > pair[:, 1]), answer)
    table = pd.DataFrame({"low": low, "high": high, "said": said, "who": who})
    shared = int((table.groupby(["low", "high"]).size() > 1).sum())
    strict = table[table["said"] <= Answer.SECOND]
    votes = strict.groupby(["low", "high"])["said"].agg(["sum", "size"])
    n, ones = votes["size"].astype(float), votes["sum"].astype(float)
    pairs = float((n * (n - 1)).sum())
    same = float((ones * (ones - 1) + (n - ones) * (n - ones - 1)).sum())
    known = table[table["who"] >= 0]
    duplicates = int(known.duplicated().sum())
    own = strict[strict["who"] >= 0].groupby(["who", "low", "high"])["said"].nunique()
    return shared, same / pairs if pairs else float("nan"), duplicates, int((own > 1).sum())
