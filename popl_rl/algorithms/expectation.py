"""The E-step of expectation maximisation, shared by every mixture here."""

from typing import NamedTuple

from torch import Tensor

__all__ = ["Expectation", "expect"]

#: Share that a component keeps at least, so that one that has lost everything may win back.
_LEAST_SHARE = 1e-3


class Expectation(NamedTuple):
    """What an E-step finds out.

    Attributes:
        responsibility: Chance that each component speaks for each case, ``[..., K, C]``, summing
            to 1 over the K components.
        evidence: Log-likelihood of each case under the mixture, ``[..., C]``.
    """

    responsibility: Tensor
    evidence: Tensor


def expect(log_likelihood: Tensor, share: Tensor, *, active: Tensor | None = None) -> Expectation:
    """Which component of a mixture does each case belong to?

    Dempster, Laird and Rubin (1977): ``share_k p(case | k)``, normalised over the components.

    Args:
        log_likelihood: Of each case under each component, ``[..., K, C]``.
        share: Shares of the components, ``[..., K]``.
        active: Components that are in use, ``[..., K]`` bool; all if None.
    """
    log_share = share.clamp(min=_LEAST_SHARE).log()
    if active is not None:
        log_share = log_share.masked_fill(~active, float("-inf"))
    joint = log_likelihood + log_share.unsqueeze(-1)
    return Expectation(joint.softmax(-2), joint.logsumexp(-2))
