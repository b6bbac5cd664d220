"""How a rater answers once both segments have a utility: the response model of B-Pref."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from popl_rl.keys import Answer

__all__ = ["Response"]


_EQUAL = 1e-6


@dataclass(frozen=True)
class Response:
    """How a rater answers once both segments have a worth.

    The response model of B-Pref (Lee et al., 2021, arXiv 2111.03026).

    The order is B-Pref's: skip, equal, rational choice, mistake. It differs in four points: every
    threshold is compared with the myopic sum, which is what the rater perceives, where B-Pref takes
    the plain sum for skips and ties; thresholds are absolute instead of scaled by recent returns; a
    greedy rater calls a tie when the sums are equal, where B-Pref then prefers the first; and
    greedy is ``rationality=inf`` instead of a negative number.

    Attributes:
        rationality: β of P(second) = sigmoid(β (worth of second − worth of first)); infinite always
            prefers the better one, 0 answers at random.
        mistake: Probability of saying the opposite. Ties and skips are never mistaken.
        myopia: γ of the weights γ^(T−1−t): below 1 the last steps count most.
        tie: Answers TIE when the worths differ by at most this. 0 means equal up to rounding (1e-6,
            relative above 1).
        skip: Answers SKIP when both worths are at most this; None never skips.

    Raises:
        ValueError: If a value is out of its range.
    """

    rationality: float = math.inf
    mistake: float = 0.0
    myopia: float = 1.0
    tie: float = 0.0
    skip: float | None = None

    def __post_init__(self) -> None:
        # Written so that NaN fails too.
        if not self.rationality >= 0:
            raise ValueError(
                f"rationality must be at least 0 (inf is greedy), got {self.rationality}."
            )
        if not 0 <= self.mistake <= 1:
            raise ValueError(f"mistake must be a probability in [0, 1], got {self.mistake}.")
        if not 0 < self.myopia <= 1:
            raise ValueError(
                f"myopia must be in (0, 1] (1 weighs all steps alike), got {self.myopia}."
            )
        if not 0 <= self.tie < math.inf:
            raise ValueError(f"tie must be finite and at least 0, got {self.tie}.")
        if self.skip is not None and not math.isfinite(self.skip):
            raise ValueError(f"skip must be finite, or None for never, got {self.skip}.")

    def answer(self, sums: Tensor, generator: torch.Generator) -> Tensor:
        """Answer pairs.

        The generator is used alike whatever the sums are.

        Args:
            sums: ``[M, 2]`` float, the (myopic) segment_utility of both segments of each pair.
            generator: Source of randomness, on the device of ``sums``.

        Returns:
            ``[M]`` int64, each an ``popl_rl.keys.Answer``.

        Raises:
            ValueError: If ``sums`` is of another shape or not finite.
        """
        if sums.ndim != 2 or sums.shape[1] != 2:
            raise ValueError(f"sums must have shape [pairs, 2], got {list(sums.shape)}.")
        if not bool(sums.isfinite().all()):
            raise ValueError("sums must be finite, got NaN or infinite worths.")
        sums = sums.double()
        draws = torch.rand(sums.shape, generator=generator, device=sums.device, dtype=sums.dtype)
        difference = sums[:, 1] - sums[:, 0]
        if math.isinf(self.rationality):
            second = difference > 0
        else:
            second = draws[:, 0] < torch.sigmoid(self.rationality * difference)
        second = second ^ (draws[:, 1] < self.mistake)
        answers = torch.where(second, int(Answer.SECOND), int(Answer.FIRST))
        rounding = _EQUAL * sums.abs().amax(1).clamp(min=1)
        answers[difference.abs() <= rounding.clamp(min=self.tie)] = int(Answer.TIE)
        if self.skip is not None:
            answers[sums.amax(1) <= self.skip] = int(Answer.SKIP)
        return answers
