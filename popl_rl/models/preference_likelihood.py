"""How likely raters' answers are in the eyes of hypotheses.

A strict answer under the logistic model with slips; a tie under that of Rao and Kupper (1967); a
ranking under that of Plackett (1975) and Luce (1959).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from scipy.optimize import minimize_scalar
from torch import Tensor

from popl_rl.data.comparisons import Comparisons

__all__ = [
    "MISTAKE",
    "InParts",
    "answer_likelihood",
    "drawn_likelihood",
    "fit_threshold",
    "leave_one_out",
    "log_likelihood",
    "per_case",
]

#: Chance of a slip that is reckoned with, which keeps single answers from ruling a hypothesis out.
MISTAKE = 0.05

_THRESHOLDS = (1e-3, 20.0)  # of the model of draws, in units of margins


def log_likelihood(margin: Tensor, mistake: float = MISTAKE) -> Tensor:
    """Log-likelihood of answers with these margins, if some answers are slips.

    ``log((1 - mistake) sigmoid(margin) + mistake sigmoid(-margin))``: no answer counts for less
    than ``log(mistake)``, so that slips are not learnt by heart.

    Args:
        margin: Margins of what was preferred over what was not, of any shape.
        mistake: Chance of a slip, in [0, 0.5).

    Returns:
        Log-likelihoods, in the shape of ``margin``.

    Raises:
        ValueError: If ``mistake`` is outside [0, 0.5).
    """
    return _with_slips(F.logsigmoid(margin), F.logsigmoid(-margin), mistake)


def _with_slips(right: Tensor, wrong: Tensor, mistake: float) -> Tensor:
    """Log-likelihood of what was said, from that of it and of what else may have been meant."""
    if not 0 <= mistake < 0.5:
        raise ValueError(f"mistake must be in [0, 0.5), got {mistake}")
    if mistake == 0:
        return right
    meant, slipped = _log_chances(mistake, right.dtype)
    return torch.logaddexp(meant + right, slipped + wrong)


@cache
def _log_chances(mistake: float, dtype: torch.dtype) -> tuple[float, float]:
    """Logarithms of the chances of what was meant and of a slip, as tensors of a type have them."""
    meant, slipped = torch.tensor([1 - mistake, mistake], dtype=dtype).log().tolist()
    return meant, slipped


def answer_likelihood(
    margin: Tensor,
    comparisons: Comparisons,
    mistake: float = MISTAKE,
    part: slice = slice(None),
) -> Tensor:
    """Log-likelihood of the answers that comparisons are of, at each of these.

    Sums over comparisons by their weights are those over answers: a stage of J comparisons stands
    at each of them, which counts 1 / J; so does a tie at its two halves.

    * A strict answer: ``log_likelihood``.
    * A stage, where an item was chosen out of J + 1: ``-softplus(logsumexp(-margin))`` over the J
      margins of the chosen one over the rest. A slip names one of the others, all alike.
    * With threshold eta, an answer is strict with ``sigmoid(margin - eta)``, or by a slip with
      ``sigmoid(-margin - eta)``. A tie has the chance ``(exp(2 eta) - 1) sigmoid(margin - eta)
      sigmoid(-margin - eta)``, of which ``2 log sigmoid(margin - eta)`` stands at each half. It is
      never a slip.

    Args:
        margin: Margins of the comparisons in the eyes of N members, ``[N, M]``.
        comparisons: The M comparisons.
        mistake: Chance of a slip, in [0, 0.5).
        part: Whose margins these are, one of ``Comparisons.answer_blocks``; all of them otherwise.

    Returns:
        ``[N, M]``.

    Raises:
        ValueError: If ``mistake`` is outside [0, 0.5).
    """
    if comparisons.stage is None:
        tied = None if comparisons.tied is None else comparisons.tied[part]
        return _of_draws(margin, tied, comparisons.threshold, mistake)
    size = comparisons.stage.bincount()
    stage = comparisons.stage.expand(margin.shape)
    most = margin.new_full((*margin.shape[:-1], len(size)), -torch.inf)
    most = most.scatter_reduce(-1, stage, -margin, "amax")
    total = torch.zeros_like(most)
    total = total.scatter_add(-1, stage, (-margin - most.gather(-1, stage)).exp())
    each = _of_stage(-(most + total.log()), size, mistake)
    return each[..., comparisons.stage]


def drawn_likelihood(
    margin: Tensor, comparisons: Comparisons, index: Tensor, mistake: float = MISTAKE
) -> Tensor:
    """As ``answer_likelihood``, of some comparisons that were drawn.

    Args:
        margin: Margins of ``comparisons.together(index)``, ``[..., B * J]``.
        comparisons: All comparisons.
        index: Those drawn, ``[..., B]`` or ``[B]``.
        mistake: Chance of a slip, in [0, 0.5).

    Returns:
        ``[..., B]``.
    """
    if comparisons.stage is None:
        tied = None if comparisons.tied is None else comparisons.tied[index]
        return _of_draws(margin, tied, comparisons.threshold, mistake)
    there = comparisons.stages[comparisons.stage[index]] >= 0
    margin = margin.unflatten(-1, there.shape[-2:])
    against = torch.where(there, -margin, -torch.inf).logsumexp(-1)
    return _of_stage(-against, there.sum(-1), mistake)


def _of_stage(margin: Tensor, others: Tensor, mistake: float) -> Tensor:
    """Log-likelihood of choices from a margin over all ``others`` together."""
    return _with_slips(F.logsigmoid(margin), F.logsigmoid(-margin) - others.log(), mistake)


def _of_draws(margin: Tensor, tied: Tensor | None, threshold: float, mistake: float) -> Tensor:
    if tied is None:
        return log_likelihood(margin, mistake)
    right = F.logsigmoid(margin - threshold)
    strict = _with_slips(right, F.logsigmoid(-margin - threshold), mistake)
    # The logarithm of exp(2 threshold) - 1, which may be too large for a number itself.
    both = 2 * threshold + math.log(-math.expm1(-2 * threshold))
    return torch.where(tied, both + 2 * right, strict)


def fit_threshold(margin: Tensor, comparisons: Comparisons, mistake: float = MISTAKE) -> float:
    """Threshold of the model of draws under which answers with these margins are likeliest.

    Args:
        margin: Margins in the eyes of one member, ``[M]``.
        comparisons: The M comparisons, some of them ``tied``.
        mistake: Chance of a slip, in [0, 0.5).

    Returns:
        The threshold, from 0.001 to 20.
    """

    def cost(threshold: float) -> float:
        likelihood = answer_likelihood(margin, replace(comparisons, threshold=threshold), mistake)
        return -float(comparisons.weighted(likelihood.double()).sum())

    return float(minimize_scalar(cost, bounds=_THRESHOLDS, method="bounded").x)


class InParts:
    """Values of K members on M comparisons, of which a part is worked out at a time.

    So memory does not grow with the comparisons: all at once are ``[K, M]``. Where several
    comparisons are of one answer, as with rankings and counted ties, they are all in one part.

    Args:
        members: How many members K.
        part: Maps a slice of the comparisons, one of ``Comparisons.answer_blocks``, to ``[K, B]``.
    """

    def __init__(self, members: int, part: Callable[[slice], Tensor]) -> None:
        self.members, self.part = members, part
        self._whole: Tensor | None = None

    @classmethod
    def of(cls, whole: "Tensor | InParts") -> "InParts":
        """One that is worked out already, ``[K, M]``, in parts."""
        if isinstance(whole, InParts):
            return whole
        return cls(len(whole), lambda part: whole[:, part])

    def blocks(self, comparisons: Comparisons) -> Iterator[tuple[slice, Tensor]]:
        """Parts of all comparisons, one after the other; a single one is worked out once."""
        parts = list(comparisons.answer_blocks(self.members))
        if len(parts) == 1:
            if self._whole is None:
                self._whole = self.part(parts[0])
            yield parts[0], self._whole
            return
        for part in parts:
            yield part, self.part(part)


def per_case(value: Tensor | InParts, comparisons: Comparisons) -> Tensor:
    """Sums over the comparisons of each case, by their weights, ``[..., M] -> [..., C]``."""
    if isinstance(value, Tensor):
        total = value.new_zeros(*value.shape[:-1], comparisons.num_cases)
        return total.index_add_(-1, comparisons.case, comparisons.weighted(value))
    total = torch.zeros(value.members, comparisons.num_cases, device=comparisons.case.device)
    for part, some in value.blocks(comparisons):
        total.index_add_(-1, comparisons.case[part], comparisons.weighted(some, part))
    return total


def leave_one_out(likelihood: Tensor | InParts, comparisons: Comparisons) -> Tensor:
    """Likelihood of each answer under the member that its case's other answers speak for.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``.
        comparisons: The M comparisons and the case of each.

    Returns:
        Log-likelihood of each comparison under that member, ``[M]``.
    """
    blocks = InParts.of(likelihood)
    total = per_case(likelihood, comparisons)
    found = []
    for part, some in blocks.blocks(comparisons):
        others = total[:, comparisons.case[part]] - comparisons.per_answer(some, part)
        found.append(some.gather(0, others.argmax(0, keepdim=True))[0])
    return torch.cat(found)
