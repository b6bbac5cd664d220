"""Distributional preference learning: a distribution of utility for each item, not a number."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor, nn

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.schedules import linear_decay
from popl_rl.optim import adam, take_step

__all__ = [
    "DistributionalReward",
    "add_independent",
    "categorical_log_preference",
    "interpolated_quantile",
    "normal_log_preference",
    "train_dpl",
]

Kind = Literal["mean_variance", "categorical"]

_REPORT = 50  # steps between two reports of progress, and two looks at the loss
# Items that all raters rank alike would drive theirs to 0, where one odd answer about them has a
# gradient that overflows. Answers do not fix the utilities' scale, so that this costs nothing.
_LEAST_STD = 0.01
_CELLS = 2**22  # entries of the largest temporary when segments are scored


def normal_log_preference(
    mean: Tensor, variance: Tensor, other_mean: Tensor, other_variance: Tensor
) -> Tensor:
    """Log-probability that one normal utility exceeds another, independent one.

    The mean-and-variance model of distributional preference learning (Siththaranjan, Laidlaw and
    Hadfield-Menell, ICLR 2024, arXiv 2312.08358):

        P(a > b) = Phi((mu_a - mu_b) / sqrt(sigma_a^2 + sigma_b^2)),

    with Phi the standard normal's distribution function. All arguments have one shape, which is
    the result's; variances are positive.
    """
    spread = (variance + other_variance).clamp_min(torch.finfo(variance.dtype).tiny).sqrt()
    chance: Tensor = torch.special.log_ndtr((mean - other_mean) / spread)
    return chance


def categorical_log_preference(probabilities: Tensor, other: Tensor) -> Tensor:
    """Log-probability that one utility on a grid exceeds another, independent one.

    The categorical model of distributional preference learning (arXiv 2312.08358). With p_a(i) the
    probability that a's utility is the i-th atom, and a fair coin for equal utilities,

        P(a > b) = sum_{i > j} p_a(i) p_b(j) + 1/2 sum_i p_a(i) p_b(i).

    Args:
        probabilities: Of the L atoms, in increasing order, ``[..., L]``.
        other: Of the same atoms, same shape.

    Returns:
        ``[...]``.
    """
    # How much of the other's mass lies below each atom: one pass instead of all pairs i, j.
    below = other.cumsum(-1) - other / 2
    chance = (probabilities * below).sum(-1)
    return chance.clamp_min(torch.finfo(chance.dtype).tiny).log()


def add_independent(probabilities: Tensor) -> Tensor:
    """Distribution of the sum of T independent utilities on equally spaced atoms.

    It is the convolution of the T distributions, computed as the product of their Fourier
    transforms. The paper compares single items; a segment's utility is the sum of its steps'.

    Args:
        probabilities: ``[..., T, K]``, each row non-negative and summing to 1.

    Returns:
        ``[..., T (K - 1) + 1]``: probabilities of the sums, from T times the lowest atom to T times
        the highest, at the same spacing.
    """
    count, atoms = probabilities.shape[-2:]
    if count == 1:
        return probabilities.squeeze(-2)
    length = count * (atoms - 1) + 1
    spectrum = torch.fft.rfft(probabilities, n=length).prod(-2)
    # Rounding leaves tiny negative values where there is no mass.
    total: Tensor = torch.fft.irfft(spectrum, n=length).clamp_min(0.0)
    return total / total.sum(-1, keepdim=True)


def interpolated_quantile(probabilities: Tensor, risk: float) -> Tensor:
    """Quantile of a distribution on equally spaced atoms, in units of the spacing.

    Each atom's mass is spread evenly over the cell of width 1 around it, so that the distribution
    function is continuous and the quantile varies smoothly: with C(i) the mass of the atoms before
    the i-th, and i the first atom with C(i) + p(i) >= risk, it is i - 1/2 + (risk - C(i)) / p(i).
    The DPL authors' risk-averse score puts the cells elsewhere, an increasing affine function of
    this one: both rank alike.

    Args:
        probabilities: ``[..., L]``.
        risk: In (0, 1).

    Returns:
        Position, where 0 is the first atom and L - 1 the last, ``[...]``.
    """
    reached = probabilities.cumsum(-1)
    last = probabilities.shape[-1] - 1
    atom = (reached < risk).sum(-1, keepdim=True).clamp_max(last)
    mass = probabilities.gather(-1, atom)
    before = reached.gather(-1, atom) - mass
    share = ((risk - before) / mass).clamp(0.0, 1.0)
    return (atom - 0.5 + share).squeeze(-1)


@dataclass(frozen=True)
class DistributionalReward:
    """A utility distribution for every observation (DPL, arXiv 2312.08358).

    A segment's utility is the sum of its steps', which are taken as independent: means and
    variances add. Actions are not looked at; if raters care for them, they belong in the
    observation.

    Args:
        network: ``[..., O]`` to ``[..., 2]``, the mean and the standard deviation before softplus
            (and an added 0.01, the least there is), or to ``[..., K]``, the logits of K atoms
            evenly spaced on [0, 1].
        kind: ``"mean_variance"`` or ``"categorical"``.

    Raises:
        ValueError: If ``kind`` is neither.

    Example:
        >>> reward = train_dpl(bank, comparisons, kind="mean_variance",
        ...     generator=torch.Generator().manual_seed(0))  # doctest: +SKIP
        >>> reward.hidden_context(bank)  # doctest: +SKIP
        0.02
        >>> safe = reward.scores(bank, risk=0.01).argmax()  # doctest: +SKIP
    """

    network: nn.Sequential
    kind: Kind

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind must be one of {get_args(Kind)}, got {self.kind!r}")

    @torch.no_grad()
    def step_mean_std(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the utility of single steps.

        Args:
            observation: ``[B, O]``.

        Returns:
            Two tensors ``[B]``.
        """
        mean, variance = _moments(self.kind, self.network(observation))
        return mean, variance.sqrt()

    def mean(self, bank: SegmentBank) -> Tensor:
        """Expected utility of every segment, ``[N]``."""
        return self._segment_moments(bank)[0]

    @torch.no_grad()
    def scores(self, bank: SegmentBank, *, risk: float | None = None) -> Tensor:
        """Score of every segment: its expected utility, or a quantile of its utility.

        A low quantile is the risk-averse score of arXiv 2312.08358 (there 0.01): it prefers what
        nobody minds to what some love and others hate.

        Args:
            bank: N segments.
            risk: Quantile in (0, 1), or None for the mean. In the mean-and-variance model it is mu
                + Phi^-1(risk) sigma, in the categorical one ``interpolated_quantile`` of the
                distribution of the sum.

        Returns:
            ``[N]``.

        Raises:
            ValueError: If ``risk`` is not in (0, 1).
        """
        if risk is None:
            return self.mean(bank)
        if not 0 < risk < 1:
            raise ValueError(
                f"risk must be strictly between 0 and 1, got {risk}; use a small one, such as "
                "0.01, to avoid risk, or None for the mean"
            )
        if self.kind == "mean_variance":
            mean, variance = self._segment_moments(bank)
            normal = torch.special.ndtri(torch.tensor(risk, dtype=torch.float64))
            return mean + float(normal) * variance.sqrt()
        probabilities: Tensor = self.network(bank.observation).softmax(-1)
        steps, gaps = bank.row.shape[1], probabilities.shape[-1] - 1
        size = max(1, _CELLS // (steps * (steps * gaps + 1)))
        parts = [
            interpolated_quantile(add_independent(probabilities[rows]), risk)
            for rows in bank.row.split(size)
        ]
        return torch.cat(parts) / gaps

    def hidden_context(self, bank: SegmentBank) -> float:
        """The r^2 detector of hidden context (arXiv 2312.08358).

            r^2 = Var(mu(x)) / (Var(mu(x)) + E[sigma^2(x)])

        with variance and expectation over the segments x: the share of the variance of utility that
        lies between segments. Near 1, one utility explains the answers. Well below 1, the same
        segment is worth different things at different times: something that raters know and the
        observation does not show, such as who they are, decides too. It detects and does not
        measure: on the paper's one-dimensional problem, where utilities have 0.34, the
        mean-and-variance model finds 0.02 to 0.03 and the categorical one 0.55 to 0.61; without
        hidden context they find 1.00 and 0.98 (four seeds each, default settings).

        Args:
            bank: The segments, best those that were compared.

        Returns:
            r^2 in [0, 1].
        """
        mean, variance = (part.double() for part in self._segment_moments(bank))
        between = mean.var(correction=0)
        return float(between / (between + variance.mean()))

    @torch.no_grad()
    def _segment_moments(self, bank: SegmentBank) -> tuple[Tensor, Tensor]:
        mean, variance = _moments(self.kind, self.network(bank.observation))
        return mean[bank.row].sum(1), variance[bank.row].sum(1)


def train_dpl(
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    kind: Kind,
    atoms: int = 10,
    hidden: tuple[int, ...] = (64, 64),
    steps: int = 1500,
    batch_size: int = 256,
    learning_rate: float = 2e-3,
    entropy: float = 0.3,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
) -> DistributionalReward:
    """Fit utility distributions to comparisons by maximum likelihood.

    Distributional preference learning (Siththaranjan, Laidlaw and Hadfield-Menell, ICLR 2024, arXiv
    2312.08358) minimises the mean of -log P(preferred > other) over the comparisons, where P is
    that of ``normal_log_preference`` or of ``categorical_log_preference``. Neither looks at who
    answered: hidden groups become spread of utility. The model flips its coins for each segment
    anew; that one rater answers on both sides of a comparison, it cannot say.

    Args:
        bank: Segments. Their observations are looked at, their actions are not.
        comparisons: M strict preferences between them.
        kind: ``"mean_variance"`` or ``"categorical"``. The categorical one holds about T^2 K / 2
            complex numbers for a segment of T steps, so that it suits short segments.
        atoms: Atoms K of the categorical distribution, evenly on [0, 1]; at least 2. Unused
            otherwise.
        hidden: Units of each hidden layer.
        steps: Gradient steps (Adam; the learning rate falls to 0 over the second half).
        batch_size: Comparisons per step, drawn with replacement.
        learning_rate: Adam's step size.
        entropy: Weight of the entropy of the distribution averaged over a batch's steps, which is
            maximised with the likelihood: answers do not fix the utilities' scale, and this spreads
            them over all atoms. Unused by ``"mean_variance"``. The authors' script for language
            models has 0.1, their stateless one none; on the paper's one-dimensional problem
            (500 steps, four seeds) 0.3 leaves a held-out loss of 0.33, 0.1 one of 0.36, missing the
            hidden context of one seed, and a problem without hidden context is learnt alike.
        generator: Source of initial weights and batches, on the device of the bank.
        progress: Called with the number of steps done.

    Returns:
        The trained model.

    Raises:
        ValueError: If ``kind`` is unknown; ``atoms`` is below 2 or another number out of range;
            there are no comparisons; all observations are equal, or those of the two segments are
            the same in every comparison, so that there is nothing to learn from; or the loss
            becomes NaN or infinite.
    """
    _check(bank, comparisons, kind, atoms, steps, batch_size, learning_rate, entropy)
    outputs = 2 if kind == "mean_variance" else atoms
    spec = PolicySpec(bank.observation.shape[1], outputs, True, tuple(hidden))
    device = bank.observation.device
    network = build_network(spec, generator=generator).to(device)
    optimizer = adam(network.parameters(), lr=learning_rate)
    schedule = linear_decay(optimizer, steps)
    for done in range(1, steps + 1):
        index = torch.randint(len(comparisons), (batch_size,), generator=generator, device=device)
        segment = torch.cat([comparisons.preferred[index], comparisons.other[index]])
        loss = _loss(kind, _step_outputs(network, bank, segment), entropy)
        take_step(optimizer, loss)
        schedule.step()
        if done % _REPORT == 0 or done == steps:
            # NaN and infinity stay in the weights, so that looking now and then is enough.
            value = float(loss.detach())
            if not math.isfinite(value):
                raise ValueError(
                    f"the loss must be finite, got {value} by step {done}; look for NaN and very "
                    f"large values in the observations, or lower learning_rate ({learning_rate})"
                )
            if progress is not None:
                progress(done)
    return DistributionalReward(network.requires_grad_(False), kind)


def _moments(kind: Kind, output: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of a step's utility from network outputs ``[..., 2 or K]``."""
    if kind == "mean_variance":
        return output[..., 0], (_LEAST_STD + F.softplus(output[..., 1])).square()
    probabilities = output.softmax(-1)
    value = torch.linspace(0, 1, output.shape[-1], device=output.device)
    mean = probabilities @ value
    return mean, (probabilities * (value - mean.unsqueeze(-1)).square()).sum(-1)


def _step_outputs(network: nn.Sequential, bank: SegmentBank, segment: Tensor) -> Tensor:
    """Network outputs at every step of some segments, ``[B, T, 2 or K]``."""
    row = bank.row[segment]
    if bank.is_shared and len(bank.observation) <= row.numel():
        outputs: Tensor = network(bank.observation)[row]
    else:
        outputs = network(bank.observation[row])
    return outputs


def _loss(kind: Kind, output: Tensor, entropy: float) -> Tensor:
    """Loss of a batch ``[2 B, T, 2 or K]``: the preferred segments, then the others."""
    if kind == "mean_variance":
        mean, variance = (part.sum(1).chunk(2) for part in _moments(kind, output))
        return -normal_log_preference(mean[0], variance[0], mean[1], variance[1]).mean()
    total = add_independent(output.softmax(-1))
    likelihood = categorical_log_preference(*total.chunk(2)).mean()
    # Through logarithms, for an atom that is never used has a probability that rounds to 0.
    each = output.flatten(0, -2).log_softmax(-1)
    used = each.logsumexp(0) - math.log(len(each))
    return entropy * (used.exp() * used).sum() - likelihood


def _check(
    bank: SegmentBank,
    comparisons: Comparisons,
    kind: Kind,
    atoms: int,
    steps: int,
    batch_size: int,
    learning_rate: float,
    entropy: float,
) -> None:
    if kind not in get_args(Kind):
        raise ValueError(f"kind must be one of {get_args(Kind)}, got {kind!r}")
    if atoms < 2:
        raise ValueError(f"atoms must be at least 2, got {atoms}; a single utility ranks nothing")
    for name, count in (("steps", steps), ("batch_size", batch_size)):
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
    if not 0 < learning_rate < math.inf:
        raise ValueError(f"learning_rate must be positive and finite, got {learning_rate}")
    if not 0 <= entropy < math.inf:
        raise ValueError(f"entropy must be finite and at least 0, got {entropy}")
    if len(comparisons) == 0:
        raise ValueError("comparisons must hold at least one strict preference, got none")
    if (bank.observation == bank.observation[0]).all():
        raise ValueError(
            f"bank must hold different observations, got {len(bank.observation)} equal ones: "
            "utility depends on the observation alone"
        )
    if not any(_differences(bank, comparisons)):
        raise ValueError(
            "comparisons must hold a pair of segments with different observations, but in all "
            f"{len(comparisons)} both sides show the same: nothing tells preferred from other; put "
            "what raters look at (such as the action) into the observation"
        )


def _differences(bank: SegmentBank, comparisons: Comparisons) -> Iterator[bool]:
    """For each comparison, whether its sides differ in more than the order of observations."""
    pairs = zip(comparisons.preferred.tolist(), comparisons.other.tolist(), strict=True)
    for pair in pairs:
        first, second = (bank.observation[bank.row[side]] for side in pair)
        # Sorted by unique, with how often each occurs: what a sum over the steps can tell apart.
        seen, known = (side.unique(dim=0, return_counts=True) for side in (first, second))
        yield not (torch.equal(seen[0], known[0]) and torch.equal(seen[1], known[1]))
