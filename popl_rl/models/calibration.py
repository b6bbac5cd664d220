"""How firmly a set's scores should be believed, when it is catered to a rater."""

from collections.abc import Sequence

import torch
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.models.preference_likelihood import (
    MISTAKE,
    InParts,
    answer_likelihood,
    leave_one_out,
)

__all__ = ["MISTAKES", "SCALES", "fit_response", "fit_scale", "scale_for_strangers"]

#: Scales that are tried: powers of two from an eighth to 32.
SCALES = tuple(2.0**power for power in range(-3, 6))

#: Chances of a slip that are tried.
MISTAKES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)

_COARSE = tuple(2.0**power for power in range(-5, 3))  # for raters not learnt of


def fit_scale(
    margin: Tensor | InParts, comparisons: Comparisons, *, mistake: float = MISTAKE
) -> float:
    """Scale of the margins under which catering predicts raters' answers best.

    Members are trained with scores of some scale, but what a rater's answers tell of two members
    depends on it: too small, and whoever has the largest margins wins with fewer answers on its
    side; too large, and the number of answers is all that counts. So a scale is fitted, as one
    would fit the raters' rationality: each answer is predicted by the member that the rater's other
    answers speak for, and the likelihood of all answers is maximised over ``SCALES``.

    Args:
        margin: Margins of the N members on M comparisons, ``[N, M]``, at once or in parts.
        comparisons: The comparisons, a case for each rater.
        mistake: Chance that an answer is a slip, in [0, 0.5), as in catering.

    Returns:
        The factor for the margins; 1 if there is nothing to choose, since there is a single member
        or no rater has more than one answer.

    Raises:
        ValueError: If ``mistake`` is outside [0, 0.5).
    """
    margin = InParts.of(margin)
    if margin.members == 1 or comparisons.is_single:
        return 1.0
    values = [_evidence(margin, scale, comparisons, mistake) for scale in SCALES]
    return SCALES[int(torch.stack(values).argmax())]


def fit_response(
    margin: Tensor, comparisons: Comparisons, *, mistake: float | None = None
) -> tuple[float, float]:
    """Scale of the margins, and chance of a slip, under which raters' answers are predicted best.

    For raters whom the members have not learnt of, of whom they may be much too sure: so scales
    down to a thirty-second are tried. As in ``fit_scale``, each answer is predicted by the member
    that its rater's other answers speak for. First the scale is fitted, then the chance of a slip,
    then the scale again, finer.

    Args:
        margin: Margins of the N members on M comparisons, ``[N, M]``.
        comparisons: The comparisons, a case for each rater.
        mistake: Chance of a slip, in [0, 0.5); fitted if None.

    Returns:
        The factor for the margins, and the chance of a slip, the given one or one of ``MISTAKES``.

    Raises:
        ValueError: If ``mistake`` is outside [0, 0.5).
    """
    parts = InParts.of(margin)

    def value(scale: float, slip: float) -> float:
        return float(_evidence(parts, scale, comparisons, slip))

    scale = max(_COARSE, key=lambda one: value(one, MISTAKE if mistake is None else mistake))
    slip = max(MISTAKES, key=lambda one: value(scale, one)) if mistake is None else mistake
    near = (scale / 2, scale / 2**0.5, scale, scale * 2**0.5, scale * 2)
    return max(near, key=lambda one: value(one, slip)), slip


def scale_for_strangers(margins: Sequence[Tensor], comparisons: Sequence[Comparisons]) -> float:
    """How much scores are to be believed by people whom nobody has learnt of.

    Args:
        margins: Of each fold the margins of its members, on people of whom they have not learnt.
        comparisons: Of each fold the answers of these people.

    Returns:
        The geometric mean over the folds, see ``fit_response``.
    """
    each = [
        fit_response(margin, answers, mistake=MISTAKE)[0]
        for margin, answers in zip(margins, comparisons, strict=True)
    ]
    return float(torch.tensor(each, dtype=torch.float64).log().mean().exp())


def _evidence(margin: InParts, scale: float, comparisons: Comparisons, mistake: float) -> Tensor:
    """How well each answer is predicted from its rater's others, with margins times a factor."""
    scaled = comparisons.scaled(scale)

    def likelihood(part: slice) -> Tensor:
        return answer_likelihood(scale * margin.part(part), scaled, mistake, part)

    predicted = leave_one_out(InParts(margin.members, likelihood), scaled)
    return comparisons.weighted(predicted).mean()
