"""Scores of segments, margins of comparisons and values of cases in the eyes of a population."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.convolutions import Patches
from popl_rl.models.layers import apply_layers, apply_shared, change_layers, some_layers
from popl_rl.models.population import Population, added_up
from popl_rl.models.reward_functions import RewardSpec

__all__ = [
    "PassShares",
    "case_means",
    "case_sums",
    "case_values",
    "margins",
    "margins_of",
    "pass_shares",
    "rater_accuracy",
    "segment_scores",
]


# A CPU core multiplies fastest what stays in its cache from one layer to the next.
_ROWS = 1024  # observations looked at together


# Margins that are held at once.
_MARGINS = 2**22

_BLOCK = 2**18  # outputs of a layer, over these observations and some members


def _chunks(total: int, size: int) -> Iterator[slice]:
    for start in range(0, total, size):
        yield slice(start, min(start + size, total))


@torch.no_grad()
def segment_scores(
    population: Population,
    bank: SegmentBank,
    *,
    alpha: float = 1.0,
    discount: float = 1.0,
    wanted: Tensor | None = None,
    memory_mb: float = 256.0,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Score every segment once per member: ``S_n(sigma) = sum_t gamma^t alpha log pi_n(a_t|s_t)``.

    The score inside the CPL loss (arXiv 2310.13639, equation 5); for reward functions the sum of
    rewards, ``sum_t gamma^t alpha r_n(s_t, a_t)``.

    Observations that occur more than once in the bank are looked at once where actions are
    discrete, and by reward functions. What a frozen trunk makes of the bank is kept for the next
    call as long as it takes at most half of ``memory_mb``, else worked out again in chunks. Heads
    of reward functions are linear: they score a segment by the sum of its features. Members that
    are known to be equal are scored once.

    Args:
        population: N members.
        bank: The segments.
        alpha: Temperature of CPL's maximum-entropy policies.
        discount: Per-step discount gamma.
        wanted: Segments whose scores are needed, ``[W]``, each once; all if None. Scores of others
            are NaN where leaving them out saves something.
        memory_mb: Bound on the temporaries and on what is kept, in MiB, beside the result itself;
            work is cut into chunks that fit, down to one segment and one member.
        dtype: Precision in which the members' own layers are multiplied. ``torch.bfloat16`` pays
            on processors that multiply it in hardware (AMX, AVX-512 BF16, CUDA) and is many times
            slower on others; margins are off by some thousandths of their spread, so that
            nearly tied pairs may change sides. Sums over steps are float32 always.

    Returns:
        ``[N, num_segments]`` float32.
    """
    population, place = population.without_repeats()
    scoring = _Scoring(population, bank, discount, int(memory_mb * 2**18), dtype)
    scores = torch.empty(len(population), len(bank), device=population.device)
    if scoring.can_look_up():
        scoring.look_up(scores)
    elif len(scoring.layers) == 1 and isinstance(population.spec, RewardSpec):
        scoring.add_up(scores)
    else:
        scoring.walk(scores, wanted)
    scores.mul_(alpha)
    return scores if place is None else scores[place]


class _Scoring:
    """The three ways to score; ``numbers`` of four bytes may be used, half of them kept."""

    def __init__(
        self,
        population: Population,
        bank: SegmentBank,
        discount: float,
        numbers: int,
        dtype: torch.dtype,
    ) -> None:
        self.population, self.bank, self.dtype = population, bank, dtype
        self.spec, self.trunk = population.spec, population.trunk
        self.layers = change_layers(population.layers(), lambda tensor: tensor.to(dtype))
        self.numbers = numbers
        self.steps = bank.row.shape[1]
        self.discount = discount
        # Two or three results of a layer are alive at once, and as many of the trunk's.
        block = numbers // 32
        if population.device.type == "cpu":
            block = min(block, _BLOCK)
        spec = self.spec
        width = max(spec.observation_dim, *spec.hidden, spec.action_dim)
        cut = [layer for layer in (*self.trunk, *self.layers) if isinstance(layer, Patches)]
        width = max([width, *(layer.count * layer.features for layer in cut)])
        self.rows = max(1, min(_ROWS, block // width))
        own = spec.action_dim if len(self.layers) == 1 else width
        self.members = max(1, block // (self.rows * own))

    def can_look_up(self) -> bool:
        """Whether scores of a member's every choice at every distinct observation fit."""
        cells = len(self.bank.observation) * self.spec.action_dim
        return self.spec.discrete and self.bank.is_shared and 8 * cells <= self.numbers

    def look_up(self, scores: Tensor) -> None:
        """Few distinct observations: a table of step scores answers for every step."""
        bank, spec, steps = self.bank, self.spec, self.steps
        distinct, choices = len(bank.observation), spec.action_dim
        features = self._features()
        for some in _chunks(len(scores), max(1, self.numbers // (8 * distinct * choices))):
            layers = some_layers(self.layers, some)
            count = len(scores[some])
            table = torch.empty(count, distinct, choices, device=scores.device)
            for rows in _chunks(distinct, self.rows):
                seen = self._see(rows, features)
                for members in _chunks(count, self.members):
                    output = apply_layers(some_layers(layers, members), seen)
                    table[members, rows] = spec.table(output.float())
            # Rows of all members' scores, added up over the steps of each segment.
            cells = table.flatten(1).T.contiguous()
            for part in _chunks(len(bank), max(1, self.numbers // (8 * (4 * steps + count)))):
                cell = bank.row[part] * choices + bank.action[part]
                weight = self._weights(part).expand(cell.shape).contiguous()
                scores[some, part] = F.embedding_bag(
                    cell, cells, mode="sum", per_sample_weights=weight
                ).T

    def add_up(self, scores: Tensor) -> None:
        """Heads linear in the features: add these up over the steps, then multiply once."""
        layer = self.layers[0]
        assert isinstance(layer, tuple)
        assert layer[0] is not None
        heads = layer[0].flatten(1)
        width = heads.shape[1]
        sums = None
        if len(self.bank) * width <= self.numbers // 2:
            sums = self._keep(("sums", self.discount), lambda: self._all_sums(width))
        size = max(1, self.rows // (1 if sums is not None else self.steps))
        for part in _chunks(len(self.bank), size):
            some = self._sums(part) if sums is None else sums[part]
            scores[:, part] = heads @ some.to(self.dtype).T

    def _all_sums(self, width: int) -> Tensor:
        sums = torch.empty(len(self.bank), width, device=self.bank.row.device)
        for part in _chunks(len(sums), max(1, self.rows // self.steps)):
            sums[part] = self._sums(part)
        return sums

    def _sums(self, part: slice) -> Tensor:
        """Discounted sums of features, apart for each choice, ``[P, K * F]``."""
        row, action = self.bank.row[part], self.bank.action[part]
        features: Tensor = self.trunk(self.bank.observation[row])
        chosen = F.one_hot(action, self.spec.action_dim) * self._weights(part).unsqueeze(-1)
        return (chosen.mT @ features).flatten(1)

    def walk(self, scores: Tensor, wanted: Tensor | None) -> None:
        """Look at every step of every segment, or of those that are wanted."""
        bank, spec = self.bank, self.spec
        if wanted is not None and len(wanted) == len(bank):
            wanted = None
        if wanted is not None:
            wanted = wanted.to(bank.row.device)
            scores.fill_(torch.nan)
        features = self._features()
        count = len(bank) if wanted is None else len(wanted)
        for chunk in _chunks(count, max(1, self.rows // self.steps)):
            part = chunk if wanted is None else wanted[chunk]
            seen = self._see(bank.row[part].flatten(), features)
            layers, seen = apply_shared(self.layers, seen)
            action, weight = bank.action[part].flatten(0, 1), self._weights(part)
            for members in _chunks(len(scores), self.members):
                output = apply_layers(some_layers(layers, members), seen)
                value = spec.step_scores(output.float(), action).unflatten(1, (-1, self.steps))
                scores[members, part] = added_up(value, weight)

    def _weights(self, part: slice | Tensor) -> Tensor:
        """What the steps of these segments count for, ``[T]`` or ``[P, T]``."""
        return self.bank.weights(part, discount=self.discount)

    def _features(self) -> Tensor | None:
        """The trunk's outputs at all distinct observations, if they may be kept."""
        if not len(self.trunk):
            return self.bank.observation
        width = self.spec.hidden[-1]
        if len(self.bank.observation) * width > self.numbers // 2:
            return None
        return self._keep(("features",), lambda: self._all_features(width))

    def _all_features(self, width: int) -> Tensor:
        observation = self.bank.observation
        features = torch.empty(len(observation), width, device=observation.device)
        for part in _chunks(len(features), self.rows):
            features[part] = self.trunk(observation[part])
        return features

    def _keep(self, purpose: tuple[object, ...], make: Callable[[], Tensor]) -> Tensor:
        return self.population.trunk_cache.get(self.trunk, self.bank, purpose, make)

    def _see(self, rows: slice | Tensor, features: Tensor | None) -> Tensor:
        """Features at these rows of the distinct observations."""
        seen = self.trunk(self.bank.observation[rows]) if features is None else features[rows]
        return seen.to(self.dtype)


def margins(
    population: Population,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    alpha: float = 1.0,
    discount: float = 1.0,
) -> Tensor:
    """Margins ``Delta = S(sigma+) - S(sigma-)`` of every member on every comparison.

    Args:
        population: N members.
        bank: Segments that the comparisons refer to.
        comparisons: M comparisons.
        alpha: Scale of the scores, as for ``segment_scores``.
        discount: Per-step discount.

    Returns:
        ``[N, M]`` float32; a positive margin is a pass.
    """
    wanted = comparisons.segments(len(bank))
    scores = segment_scores(population, bank, alpha=alpha, discount=discount, wanted=wanted)
    return margins_of(scores, comparisons)


def margins_of(scores: Tensor, comparisons: Comparisons, part: slice = slice(None)) -> Tensor:
    """Margins of comparisons, or of a part of them, by scores of segments ``[N, segments]``."""
    preferred, other = comparisons.preferred[part], comparisons.other[part]
    return scores.index_select(1, preferred) - scores.index_select(1, other)


def case_values(passes: Tensor, comparisons: Comparisons) -> Tensor:
    """Share of each case's comparisons that each member passes.

    Args:
        passes: ``[N, M]`` bool.
        comparisons: The M comparisons and the case of each.

    Returns:
        ``[N, C]`` float32; 0 or 1 where a case is a single preference. Of soft labels and ties,
        which are comparisons both ways with weights, it is the weighted share.
    """
    total = torch.zeros(len(passes), comparisons.num_cases, device=passes.device)
    total.index_add_(1, comparisons.case, comparisons.weighted(passes.float()))
    return total / comparisons.sizes().clamp(min=1e-6)


def case_sums(
    scores: Tensor, comparisons: Comparisons, value: Callable[[Tensor], Tensor]
) -> Tensor:
    """Sums over each case's comparisons of what follows from their margins, by their weights.

    Blocks of comparisons are worked out one after the other, so that memory does not grow with
    their number.

    Args:
        scores: Scores of the segments, ``[N, segments]``.
        comparisons: M comparisons and the case of each.
        value: Maps margins ``[N, B]`` of some comparisons to values of the same shape.

    Returns:
        ``[N, C]`` float32.
    """
    total = torch.zeros(len(scores), comparisons.num_cases, device=scores.device)
    for part in comparisons.blocks(max(1, _MARGINS // len(scores))):
        some = value(margins_of(scores, comparisons, part)).float()
        if comparisons.weight is not None:
            some = some * comparisons.weight[part]
        total.index_add_(1, comparisons.case[part], some)
    return total


def case_means(
    scores: Tensor, comparisons: Comparisons, value: Callable[[Tensor], Tensor]
) -> Tensor:
    """Means in the place of ``case_sums``; 0 for a case without comparisons."""
    return case_sums(scores, comparisons, value) / comparisons.sizes().clamp(min=1e-6)


class PassShares(NamedTuple):
    """What a population passes.

    Attributes:
        values: Share of each case's comparisons that each member passes, ``[N, C]``.
        mean: Share of all comparisons that members pass on average.
    """

    values: Tensor
    mean: float


def pass_shares(scores: Tensor, comparisons: Comparisons) -> PassShares:
    """Which share of each case's comparisons each member passes, as of ``case_values``.

    Args:
        scores: Scores of the segments, ``[N, segments]``.
        comparisons: M comparisons and the case of each.
    """
    count = 0

    def passes(margin: Tensor) -> Tensor:
        nonlocal count
        passed = margin > 0
        count += int(passed.count_nonzero())
        return passed

    values = case_means(scores, comparisons, passes)
    return PassShares(values, count / (len(scores) * len(comparisons)))


def rater_accuracy(values: Tensor, quantile: float = 0.1) -> float:
    """A low quantile over cases of the best member's value: is anybody left out?

    Needs no group labels: it is small as long as some raters find no member that serves them.

    Args:
        values: Share of each case's comparisons that each member passes, ``[N, C]``.
        quantile: Quantile over the cases, in [0, 1].
    """
    return float(values.amax(0).quantile(quantile))
