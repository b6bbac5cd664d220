"""How many answers are missing: what a set learns from fewer answers, and where that leads.

The share of further answers that a method gets wrong falls with the m answers that it learns from
about as ``floor + slope * m ** -power`` (Hestness et al., 2017, arXiv 1712.00409), with powers
between 1/2, the rate of learning where nothing fits the truth, and 1, where something does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

__all__ = ["TOLERATED", "LearningCurve", "fit_learning_curve"]

TOLERATED = 0.02
"""Share of further answers that may be wrong beyond those that no number of answers would mend."""

_POWERS = np.linspace(0.5, 1.0, 11)
_LIKELY = 4.0  # squared errors beyond the best fit that is about as good, at 95 %


@dataclass(frozen=True)
class LearningCurve:
    """What is learnt from more and more answers.

    Attributes:
        answers: Numbers of answers learnt from, ascending.
        wrong: Share of new raters' further answers ranked wrong after each of them.
        error: Standard error of each share over new raters.
        needed: Answers after which at most ``TOLERATED`` more are wrong than for ever.
        between: The fewest and most that are needed by fits nearly as good as the best.
        floor: Share that would stay wrong.
    """

    answers: tuple[int, ...]
    wrong: tuple[float, ...]
    error: tuple[float, ...]
    needed: int
    between: tuple[int, int]
    floor: float

    @property
    def missing(self) -> int:
        """Answers that are needed beyond the most learnt from; 0 if there are enough."""
        return max(0, self.needed - self.answers[-1])

    def warning(self, raters: int) -> str | None:
        """Say how many answers are missing, or None if none are.

        Args:
            raters: Who would give them.
        """
        if not self.missing:
            return None
        now = self.answers[-1]
        least, most = (max(0, needed - now) for needed in self.between)
        return (
            f"about {self.missing} answers are missing ({least} to {most}; "
            f"{-(-self.missing // raters)} more of each rater): of new raters' further answers "
            f"{self.wrong[-1]:.0%} are ranked wrong after learning from {now}, {self.wrong[0]:.0%} "
            f"after {self.answers[0]}, and {self.floor:.0%} would be with any number"
        )


def fit_learning_curve(
    answers: Sequence[int], wrong: Sequence[float], error: Sequence[float]
) -> LearningCurve:
    """Fit the curve by weighted least squares, with a floor and a slope that are not negative.

    Args:
        answers: Numbers of answers learnt from, ascending.
        wrong: Share of further answers ranked wrong after each.
        error: Standard error of each share, above 0.

    Raises:
        ValueError: If there are fewer than three points, or they do not go together.
    """
    m, y, spread = (np.asarray(values, dtype=float) for values in (answers, wrong, error))
    if not (len(m) == len(y) == len(spread) >= 3 and (np.diff(m) > 0).all() and (spread > 0).all()):
        raise ValueError(
            "answers must be at least three ascending numbers, each with the share wrong and its "
            f"error above 0, got {list(answers)}, {list(wrong)} and {list(error)}"
        )
    fits = []
    for power in _POWERS:
        terms = np.stack([np.ones_like(m), m**-power], axis=1)
        (floor, slope), residual = nnls(terms / spread[:, None], y / spread)
        needed = (slope / TOLERATED) ** (1 / power) if slope > 0 else 0.0
        fits.append((residual**2, int(np.ceil(needed)), floor))
    best = min(fits)
    # Where not even the best fits, errors are taken to be as large as its misfit says.
    misfit = max(1.0, best[0] / (len(m) - 2))
    near = [needed for squared, needed, _ in fits if squared <= best[0] + _LIKELY * misfit]
    return LearningCurve(
        tuple(int(one) for one in answers),
        tuple(float(one) for one in wrong),
        tuple(float(one) for one in error),
        best[1],
        (min(near), max(near)),
        float(best[2]),
    )
