"""How likely raters' answers are in the eyes of hypotheses."""

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.data.comparisons import Comparisons

__all__ = ["MISTAKE", "leave_one_out", "log_likelihood", "per_case"]

#: Chance of a slip that is reckoned with, which keeps single answers from ruling a hypothesis out.
MISTAKE = 0.05


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
    if not 0 <= mistake < 0.5:
        raise ValueError(f"mistake must be in [0, 0.5), got {mistake}")
    if mistake == 0:
        return F.logsigmoid(margin)
    chance = margin.new_tensor([1 - mistake, mistake]).log()
    return torch.logaddexp(chance[0] + F.logsigmoid(margin), chance[1] + F.logsigmoid(-margin))


def per_case(value: Tensor, comparisons: Comparisons) -> Tensor:
    """Sums over the comparisons of each case, by their weights, ``[..., M] -> [..., C]``."""
    total = value.new_zeros(*value.shape[:-1], comparisons.num_cases)
    return total.index_add_(-1, comparisons.case, comparisons.weighted(value))


def leave_one_out(likelihood: Tensor, comparisons: Comparisons) -> Tensor:
    """Likelihood of each answer under the member that its case's other answers speak for.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``.
        comparisons: The M comparisons and the case of each.

    Returns:
        Log-likelihood of each comparison under that member, ``[M]``.
    """
    own = comparisons.per_answer(likelihood)
    others = per_case(likelihood, comparisons)[:, comparisons.case] - own
    return likelihood.gather(0, others.argmax(0, keepdim=True))[0]
