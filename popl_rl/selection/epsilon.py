"""How far behind the best a member may be and still pass a case."""

import torch
from torch import Tensor

from popl_rl.selection.mad import mad

__all__ = ["Epsilon", "prepare_scores", "tolerance_per_case"]


class Epsilon:
    """Tolerance per case: given, or the median absolute deviation, worked out where it is needed.

    Args:
        values: The tolerances, ``[case]``; NaN where the deviation is to be worked out.
        scores: Scores of all members, ``[member, case]``, for the deviation.
    """

    def __init__(self, values: Tensor, scores: Tensor) -> None:
        self.values = values
        self.scores = scores
        self.missing = int(values.isnan().sum())

    def at(self, cases: Tensor) -> Tensor:
        """Tolerances of the cases at these indices, in their shape."""
        if self.missing:
            wanted = torch.unique(cases)
            wanted = wanted[self.values[wanted].isnan()]
            for part in torch.split(wanted, max(1, 2**22 // len(self.scores))):
                columns = self.scores.gather(1, part.expand(len(self.scores), -1))
                self.values[part] = mad(columns)
            self.missing -= len(wanted)
        return self.values[cases]


def prepare_scores(
    scores: Tensor, epsilon: float | Tensor | str | None, mode: str
) -> tuple[Tensor, Tensor | None]:
    """Reduce the kinds of scores and epsilon to passes, or real scores and a tolerance per case.

    The tolerance is NaN where the median absolute deviation is still to be worked out, and None
    for plain lexicase selection.
    """
    if scores.dtype in (torch.float16, torch.bfloat16):
        scores = scores.float()
    if epsilon is None:
        return scores, None
    tolerance = tolerance_per_case(epsilon, scores)
    if scores.dtype == torch.bool:
        # A fail trails a pass by 1, and the median absolute deviation of passes is at most 1/2.
        return scores | (tolerance >= 1), None
    scores = scores.to(tolerance.dtype)
    if mode != "static":
        return scores, tolerance
    everywhere = torch.arange(scores.shape[1], device=scores.device)
    return scores >= scores.amax(0) - Epsilon(tolerance, scores).at(everywhere), None


def tolerance_per_case(epsilon: float | Tensor | str, scores: Tensor) -> Tensor:
    """Check epsilon and spread it over the cases, ``[case]``."""
    num_cases = scores.shape[1]
    dtype = scores.dtype if scores.dtype.is_floating_point else torch.float64
    if isinstance(epsilon, str):
        if epsilon != "mad":
            raise ValueError(f"epsilon must be a number, a tensor, 'mad' or None, got {epsilon!r}")
        if dtype == scores.dtype and any(bool(end.isinf()) for end in scores.aminmax()):
            raise ValueError(
                "scores must be finite if epsilon is 'mad', got infinite ones; clamp them or give "
                "epsilon as a number"
            )
        return torch.full((num_cases,), torch.nan, dtype=dtype, device=scores.device)
    if isinstance(epsilon, bool) or not isinstance(epsilon, (int, float, Tensor)):
        raise TypeError(
            f"epsilon must be a number, a tensor, 'mad' or None, got {type(epsilon).__name__}"
        )
    tolerance = torch.as_tensor(epsilon, dtype=dtype, device=scores.device).detach()
    if tolerance.ndim and tolerance.shape != (num_cases,):
        raise ValueError(
            f"epsilon must be a number or one tolerance per case, shape ({num_cases},), got shape "
            f"{tuple(tolerance.shape)}"
        )
    tolerance = tolerance.expand(num_cases)
    if not bool((tolerance >= 0).all()) or bool(tolerance.isinf().any()):
        raise ValueError(
            f"epsilon must be finite and at least 0, got {float(tolerance.min())} to "
            f"{float(tolerance.max())}"
        )
    return tolerance
