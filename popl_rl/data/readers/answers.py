"""What people wrote as an answer: words, codes or soft labels."""

import numpy as np
import numpy.typing as npt
import pandas as pd

from popl_rl.data.readers.problems import Problems
from popl_rl.keys import Answer

__all__ = ["read_answers"]

_WORDS = {
    **dict.fromkeys(("a", "first", "1st", "left"), Answer.FIRST),
    **dict.fromkeys(("b", "second", "2nd", "right"), Answer.SECOND),
    **dict.fromkeys(("tie", "equal", "same", "draw"), Answer.TIE),
    **dict.fromkeys(("skip", "none", "incomparable"), Answer.SKIP),
}
_EXPECTED = (
    "an answer must be 0 (first), 1 (second), 2 (tie), 3 (skip), or a, b, tie, skip, or a soft "
    "label in [0, 1], which is how likely the second is preferred"
)


def read_answers(
    column: pd.Series, problems: Problems
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32] | None]:
    """Answers as codes, and as chances where there are soft labels.

    0 and 1 mean the same as a code and as a soft label. Where a column holds fractions, it holds
    soft labels, and what is neither 0 nor 1 nor between them is refused there; a 0.5 is a tie.

    Args:
        column: What was written in each row, text or numbers.
        problems: Where rows that make no sense are reported.

    Returns:
        An `popl_rl.keys.Answer` for each row, ``[M]``; and how likely the second is
        preferred, ``[M]``, or None if all answers are codes or words.
    """
    text = column.astype("string").str.strip().str.lower()
    by_word = text.map(_WORDS)
    number = pd.to_numeric(text.where(by_word.isna()), errors="coerce")
    value = (
        by_word.astype("Float64")
        .fillna(number.astype("Float64"))
        .to_numpy("float64", na_value=np.nan)
    )
    problems.add(text.isna(), f"the answer is missing; {_EXPECTED}")
    shown = text.fillna("")
    unknown = np.isnan(value) & text.notna().to_numpy()
    is_soft = bool((value % 1 > 0).any())
    coded = by_word.notna().to_numpy() | np.isin(value, list(Answer))
    wrong = ~np.isnan(value) & ~((value >= 0) & (value <= 1) if is_soft else coded)
    if is_soft:
        wrong &= by_word.isna().to_numpy()
    for rows in (unknown, wrong):
        if rows.any():
            what = "among soft labels, " if is_soft else ""
            problems.add(rows, f"{what}the answer is {shown[rows].iloc[0]!r}; {_EXPECTED}")
    value = np.where(np.isfinite(value), value, 0.0)
    if not is_soft:
        return np.clip(value, 0, max(Answer)).astype(np.int64), None
    words = by_word.astype("Float64").to_numpy("float64", na_value=np.nan)
    chance = np.where(words == Answer.TIE, 0.5, value)
    answer = np.where(chance == 0.5, Answer.TIE, (chance > 0.5).astype(np.int64))
    answer = np.where(words == Answer.SKIP, Answer.SKIP, answer)
    chance = np.where(words == Answer.SKIP, 0.5, chance)
    return answer.astype(np.int64), chance.astype(np.float32)
