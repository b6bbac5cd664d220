"""Strict preferences in the form a learner reads: no group, no utility, no rater model."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import ANSWER, PAIR, RATER, Answer

__all__ = ["Comparisons"]


@dataclass(frozen=True)
class Comparisons:
    """Strict preferences as a learner reads them; hidden keys are never looked at.

    Attributes:
        preferred: Segment that was preferred, ``[M]``.
        other: Segment it was preferred to, ``[M]``.
        case: What lexicase filters on: the rater's number, or the preference's own, ``[M]``.
        num_cases: Number of cases C.
        num_dropped: Ties and skips that were left out.
    """

    preferred: Tensor
    other: Tensor
    case: Tensor
    num_cases: int
    num_dropped: int = 0

    def __len__(self) -> int:
        return len(self.preferred)

    @property
    def is_single(self) -> bool:
        """Whether every case is a single preference, as where nobody kept rater ids."""
        return self.num_cases == len(self)

    @classmethod
    def from_preferences(cls, preferences: TensorDictBase, *, cases: str) -> "Comparisons":
        """Keep the strict answers.

        Args:
            preferences: TensorDict ``[M]`` with ``pair``, ``answer`` and, for rater cases,
                ``rater``.
            cases: ``"preference"`` or ``"rater"``.

        Raises:
            ValueError: If ``cases`` is neither, rater ids are needed and missing, or no answer is
                strict.
        """
        if cases not in ("preference", "rater"):
            raise ValueError(f"cases must be 'preference' or 'rater', got {cases!r}")
        if cases == "rater" and RATER not in preferences.keys():  # noqa: SIM118 - not a dict
            raise ValueError(
                "preferences must hold 'rater', the id of who answered, for cases='rater'; without "
                "ids use cases='preference'"
            )
        answer = preferences[ANSWER]
        strict = answer <= Answer.SECOND
        if not strict.any():
            raise ValueError(
                f"preferences must hold a strict answer, got {len(answer)} ties and skips; lower "
                "the raters' tie and skip thresholds or ask about more different segments"
            )
        pair, side = preferences[PAIR][strict], answer[strict].unsqueeze(-1)
        preferred = pair.gather(-1, side).squeeze(-1)
        other = pair.gather(-1, 1 - side).squeeze(-1)
        if cases == "preference":
            case = torch.arange(len(preferred), device=pair.device)
        else:
            case = preferences[RATER][strict].unique(return_inverse=True)[1]
        return cls(preferred, other, case, int(case.max()) + 1, int((~strict).sum()))

    def to(self, device: torch.device | str) -> "Comparisons":
        """The same comparisons on another device."""
        return Comparisons(
            self.preferred.to(device),
            self.other.to(device),
            self.case.to(device),
            self.num_cases,
            self.num_dropped,
        )

    def rows(self, index: Tensor) -> "Comparisons":
        """Some of the comparisons; cases keep their numbers, and nothing counts as dropped."""
        return Comparisons(
            self.preferred[index], self.other[index], self.case[index], self.num_cases
        )
