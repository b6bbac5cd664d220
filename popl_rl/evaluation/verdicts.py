"""How well each group is served, in a word that follows from intervals."""

from dataclasses import dataclass
from math import hypot, isnan, nan

import pandas as pd

from popl_rl.evaluation.statistics import RESULT_COLUMNS, require_columns

__all__ = [
    "DATA",
    "FEW",
    "LOST",
    "ORACLE",
    "PARTLY",
    "SERVED",
    "Verdict",
    "verdicts",
]

SERVED = "served"
PARTLY = "served in part"
LOST = "not found"
DATA = "no better than the data"
ORACLE = "its oracle does not act"
FEW = "too few episodes to tell"

_ENOUGH = 0.8  # share of the best known at which a group is served
_AT_LEAST = 0.6  # share that the interval must lie above
_HALF = 0.5  # share below which its policy was not found
_WIDE = 0.5  # width of an interval that says nothing
_ERRORS = 1.96  # standard errors in half a 95 % interval

#: What may be the best known for a group, by its name in a table of results.
_BEST = {
    "optimum": "the optimum",
    "ppo": "PPO on its utility",
    "oracle": "its oracle",
    "best_behaviour": "the best behaviour in the data",
    "clone": "the clone of the data",
}


@dataclass(frozen=True)
class Verdict:
    """How well a group is served.

    Attributes:
        group: Name of the group.
        word: ``SERVED``, ``PARTLY``, ``LOST``, ``DATA``, ``ORACLE`` or ``FEW``.
        share: ``(return - random) / (best known - random)`` of what new raters are given.
        low: Lower end of its 95 % interval.
        high: Upper end.
        best: What the best known is, in words.
        reason: What the word follows from, where it is not the share.
    """

    group: str
    word: str
    share: float
    low: float
    high: float
    best: str
    reason: str = ""

    def __str__(self) -> str:
        if isnan(self.share):
            return f"{self.group}: {self.word} ({self.best} has {self.reason})"
        ends = f"[{self.low:z.2f}, {self.high:z.2f}]"
        text = f"{self.group}: {self.word} ({self.share:z.2f} {ends} of {self.best}"
        return f"{text}; {self.reason})" if self.reason else f"{text})"


@dataclass(frozen=True)
class _Return:
    value: float
    error: float

    def clearly_above(self, other: "_Return") -> bool:
        """Whether the 95 % interval of the difference lies above 0."""
        return self.value - other.value > _ERRORS * hypot(self.error, other.error)


def verdicts(results: pd.DataFrame, label: str) -> list[Verdict]:
    """Put into words how well each group is served, from returns and their standard errors.

    The best known for a group is the highest return among the optimum (where every transition is
    known), PPO, the group's oracle, the best behaviour in the data and the clone of all of them,
    whatever there is. From above, the first that
    holds:

    - ``ORACLE``: nothing that is known, or not even the oracle, is clearly better than random
      actions; or the oracle is clearly worse than the data are. Unless the group is served in
      spite of that, nothing can be concluded from a recovery.
    - ``FEW``: the interval is wider than 0.5 and reaches 0.8.
    - ``SERVED``: the interval reaches 0.8 of the best known, and lies above 0.6.
    - ``DATA``: what new raters are given is not clearly better than the behaviours of the data.
    - ``LOST``: less than half of the best known; ``PARTLY``: more.

    Args:
        results: Rows of a scoreboard, ``method, choice, group, measure, value``.
        label: Name of the method that was evaluated.

    Returns:
        One for each group, in the order of the table; none without returns of the method, of random
        actions and of anything to compare with.

    Raises:
        ValueError: If a column is missing.
    """
    require_columns(results, RESULT_COLUMNS)
    chosen = results[(results.method != label) | (results.choice == "posterior")]
    chosen = chosen[chosen.measure.isin(["return", "return_error"])]
    keys = ["group", "method", "measure"]
    # The best of the data's behaviours stands for them all.
    known = chosen[chosen.method != "behaviour"].drop_duplicates(keys).set_index(keys)["value"]

    def find(group: str, method: str) -> _Return | None:
        if (group, method, "return_error") not in known.index:
            return None
        return _Return(
            float(known[group, method, "return"]), float(known[group, method, "return_error"])
        )

    found = []
    for group in dict.fromkeys(chosen.group):
        own, floor = find(group, label), find(group, "random")
        references = {name: one for name in _BEST if (one := find(group, name)) is not None}
        if own is not None and floor is not None and references:
            found.append(_verdict(group, own, floor, references, find(group, "data")))
    return found


def _verdict(
    group: str,
    own: _Return,
    floor: _Return,
    references: dict[str, _Return],
    data: _Return | None,
) -> Verdict:
    name = max(references, key=lambda one: references[one].value)
    best, oracle = references[name], references.get("oracle")
    scale = best.value - floor.value
    if not best.clearly_above(floor):
        reason = f"{best.value:.4g}, and random actions {floor.value:.4g}"
        return Verdict(group, ORACLE, nan, nan, nan, _BEST[name], reason)
    share = (own.value - floor.value) / scale
    errors = (own.error, share * best.error, (1 - share) * floor.error)
    half = _ERRORS * hypot(*errors) / scale
    low, high = share - half, share + half
    word, reason = PARTLY if share >= _HALF else LOST, ""
    compared = data if data is not None and data.value > floor.value else floor
    if high >= _ENOUGH and high - low > _WIDE:
        word = FEW
    elif high >= _ENOUGH and low >= _AT_LEAST:
        word = SERVED
    elif oracle is not None and _does_not_act(oracle, floor, compared):
        word, reason = ORACLE, f"the oracle has {oracle.value:.4g}, "
        reason += f"random actions {floor.value:.4g}"
        reason += "" if data is None else f", the data {data.value:.4g}"
    elif not own.clearly_above(compared):
        word, reason = DATA, f"{own.value:.4g}, and the data {compared.value:.4g}"
    return Verdict(group, word, share, low, high, _BEST[name], reason)


def _does_not_act(oracle: _Return, floor: _Return, data: _Return) -> bool:
    return not oracle.clearly_above(floor) or data.clearly_above(oracle)
