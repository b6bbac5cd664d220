"""Bayesian REX: linear reward functions, sampled by how well they explain the preferences."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

__all__ = ["Chain", "brex"]

_BLOCK = 100  # steps whose noise is drawn, and multiplied with the contrasts, at once
_PAIRS = 2**16  # comparisons looked at together: few enough to stay in a core's cache


@dataclass(frozen=True)
class Chain:
    """Samples of a Markov chain over reward weights, evenly spaced after burn-in.

    Attributes:
        weights: Unit vectors ``[K, F]``. A sample repeats where the chain stood still.
        log_likelihood: Log-likelihood of the comparisons under each sample, ``[K]`` float64.
        acceptance: Share of all proposals that were accepted, burn-in included.
    """

    weights: Tensor
    log_likelihood: Tensor
    acceptance: float

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def mean(self) -> Tensor:
        """Posterior mean, renormalised, ``[F]``: the sphere's own mean direction."""
        return F.normalize(self.weights.mean(0), dim=0)

    @property
    def map(self) -> Tensor:
        """The most likely of the samples, ``[F]``; under the flat prior the most probable one."""
        return self.weights[int(self.log_likelihood.argmax())]


@torch.no_grad()
def brex(
    contrast: Tensor,
    *,
    pairs: tuple[Tensor, Tensor] | None = None,
    steps: int = 10_000,
    step_std: float = 0.01,
    confidence: float = 1.0,
    burn_in: int = 0,
    keep: int = 1000,
    generator: torch.Generator,
) -> Chain:
    """Sample reward weights from their posterior by Metropolis-Hastings.

    Bayesian REX (Brown, Coleman, Srinivasan and Niekum, ICML 2020, arXiv 2002.09089). The reward
    is linear in fixed features, R(s) = w . phi(s) with |w| = 1, and a comparison is answered by

        P(sigma+ > sigma- | w) = exp(beta w . Phi+) / (exp(beta w . Phi+) + exp(beta w . Phi-))
                               = sigmoid(beta w . (Phi+ - Phi-)),

    where Phi sums phi over a segment's steps. With a flat prior on the unit sphere the posterior
    is proportional to the product of these over the comparisons. A proposal adds N(0, step_std)
    to every coordinate of w and renormalises. How likely it is to go from w to w' depends on the
    angle between them alone, since the noise is isotropic and |w| = |w'| = 1; it is therefore as
    likely as the way back (symmetric), and is accepted with probability min(1, P(D|w') / P(D|w)).
    The chain starts at a uniformly random direction.

    All raters share one posterior, so that hidden groups are not told apart: on contradicting
    comparisons it concentrates on the compromise, or the side, that explains most of them.

    The settings published with POPL (arXiv 2406.15599) are 10 000 steps of ``step_std=0.1``,
    confidence 1, no burn-in, and ``keep=10_000`` for all samples. Of these ``step_std`` has another
    default here: a step over F features is about ``step_std * sqrt(F)`` long, which with their 512
    features is 2.3, more than the sphere's diameter. On their stateless problem (2048 comparisons,
    five seeds) that chain accepts 10 to 23 of its 10 000 proposals and ends 17 to 40 nats below
    where the default ends, which accepts 3 in 10 and settles within 1000 steps. Both chains come to
    prefer larger states throughout, and so to serve one group only. With few features a larger step
    moves faster; an acceptance of 0.2 to 0.5 is what to aim at.

    Args:
        contrast: Features of the preferred segment less those of the other, each summed over the
            segment's steps, ``[M, F]`` floating point. The chain is computed in float64 and its
            samples have this dtype.
        pairs: Preferred segments and the others, ``[M]`` each, as rows of ``contrast``, which then
            holds the features of N segments, ``[N, F]``. The posterior is the same; where
            comparisons outnumber segments, a step takes less time and memory this way.
        steps: Proposals.
        step_std: Standard deviation of a proposal, per coordinate.
        confidence: Beta, the raters' rationality.
        burn_in: Steps at the start from which no sample is kept.
        keep: Samples K to keep, evenly spaced over the other steps; the last is the chain's end.
        generator: Source of randomness, on the device of ``contrast``.

    Raises:
        TypeError: If ``contrast`` is not floating point.
        ValueError: If ``contrast`` is empty, not two-dimensional, not finite or zero throughout;
            ``step_std`` or ``confidence`` is not positive and finite; a count is out of range;
            ``burn_in`` leaves no step or fewer than ``keep``; or the likelihood overflows.

    Example:
        >>> contrast = features[comparisons.preferred] - features[comparisons.other]
        ... # doctest: +SKIP
        >>> chain = brex(contrast, generator=torch.Generator().manual_seed(0))  # doctest: +SKIP
        >>> rewards = features @ chain.weights.T  # doctest: +SKIP
    """
    _check(contrast, steps, step_std, confidence, burn_in, keep)
    num_rows, num_features = contrast.shape
    device = contrast.device
    features = contrast.double()

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64, device=device)

    def likelihood(score: Tensor, step: int) -> float:
        return _log_likelihood(score, pairs, confidence, step)

    weight = F.normalize(draw(num_features), dim=0)
    score = features @ weight
    current = likelihood(score, 0)
    samples = torch.empty(keep, num_features, dtype=contrast.dtype, device=device)
    log_likelihood = torch.empty(keep, dtype=torch.float64, device=device)
    proposal = torch.empty(num_rows, dtype=torch.float64, device=device)
    accepted = kept = done = 0
    while done < steps:
        size = min(_BLOCK, steps - done)
        noise = step_std * draw(size, num_features)
        # A proposal's scores are (C w + C noise) / norm: C noise is one product for the block.
        push = noise @ features.T
        luck = torch.rand(size, generator=generator, dtype=torch.float64, device=device)
        bars = luck.log().tolist()
        for index in range(size):
            moved = weight + noise[index]
            norm = moved.norm()
            torch.add(score, push[index], out=proposal).div_(norm)
            proposed = likelihood(proposal, done + 1)
            if bars[index] < proposed - current:
                weight, current = moved / norm, proposed
                # Division by less than 1 enlarges rounding errors, which would build up.
                exact = features @ weight if norm < 1 else proposal
                score, proposal = exact, score
                accepted += 1
            done += 1
            if done == burn_in + (kept + 1) * (steps - burn_in) // keep:
                samples[kept] = weight
                log_likelihood[kept] = current
                kept += 1
    return Chain(samples, log_likelihood, accepted / steps)


def _log_likelihood(
    score: Tensor, pairs: tuple[Tensor, Tensor] | None, confidence: float, step: int
) -> float:
    """Log-likelihood of the comparisons by the scores of the rows of ``contrast``."""
    value = 0.0
    for margin in [score] if pairs is None else _margins(score, *pairs):
        value += float(F.logsigmoid(confidence * margin).sum())
    if not math.isfinite(value):
        raise ValueError(
            f"the chain's log-likelihood must be finite, got {value} at step {step}; the features "
            f"are too large: scale contrast, or choose a smaller confidence than {confidence}"
        )
    return value


def _margins(score: Tensor, preferred: Tensor, other: Tensor) -> Iterator[Tensor]:
    """Margins of the comparisons, a block after the other."""
    for better, worse in zip(preferred.split(_PAIRS), other.split(_PAIRS), strict=True):
        yield score.index_select(0, better) - score.index_select(0, worse)


def _check(
    contrast: Tensor, steps: int, step_std: float, confidence: float, burn_in: int, keep: int
) -> None:
    if contrast.ndim != 2 or contrast.numel() == 0:
        raise ValueError(
            "contrast must hold at least one comparison and one feature, [M, F], got shape "
            f"{tuple(contrast.shape)}"
        )
    if not contrast.is_floating_point():
        raise TypeError(f"contrast must be floating point, got {contrast.dtype}; use .float()")
    finite = contrast.isfinite()
    if not finite.all():
        raise ValueError(
            f"contrast must be finite, got {int((~finite).sum())} NaN or infinite values; look at "
            "the features of the segments"
        )
    if not contrast.any():
        raise ValueError(
            "contrast must tell segments apart, got zeros only: the two segments of every "
            "comparison have equal features; use features that vary"
        )
    for name, value in (("step_std", step_std), ("confidence", confidence)):
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {value}")
    for name, count, least in (("steps", steps, 1), ("burn_in", burn_in, 0), ("keep", keep, 1)):
        if count < least:
            raise ValueError(f"{name} must be at least {least}, got {count}")
    if burn_in >= steps:
        raise ValueError(
            f"burn_in must be less than steps, got {burn_in} of {steps}; take more steps"
        )
    if keep > steps - burn_in:
        raise ValueError(
            f"keep must be at most the {steps - burn_in} steps after burn-in, got {keep}; take "
            "more steps or keep fewer samples"
        )
