"""Which pairs of segments are compared, in training and in evaluation.

No pair is asked about in both: where segments say which state they go on from,
the last fifth of these states is kept for evaluation; elsewhere a pair that was asked in training
is left out of evaluation.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.pairs import draw_pairs, starts_of

__all__ = ["PairPool", "held_out_pool", "training_pool"]

#: Of the starts, this share is kept for evaluation, and never fewer than two: with four segments
#: each, a single start has six pairs.
_HELD_OUT_SHARE = 1 / 5
_FEWEST_HELD_OUT = 2
#: Times that pairs which were asked before are drawn again until drawing counts as hopeless.
_ATTEMPTS = 1000


@dataclass(frozen=True, eq=False)
class PairPool:
    """Pairs of segments that somebody may be asked about.

    Attributes:
        num_segments: Number of segments N.
        start: Segments with the same number may be compared, ``[N]`` int64; all if None.
        allowed: Segments that may be shown, ``[K]`` int64; all N if None.
        asked: Pairs that are left out, in either order, ``[M, 2]`` int64; none if None.
    """

    num_segments: int
    start: Tensor | None = None
    allowed: Tensor | None = None
    asked: Tensor | None = None

    def draw(self, num_pairs: int, *, generator: torch.Generator) -> Tensor:
        """Uniform pairs of two different segments, ``[num_pairs, 2]``; some may be drawn twice.

        Raises:
            ValueError: If (nearly) all pairs were asked already, and as ``draw_pairs``.
        """
        pairs = self._draw(num_pairs, generator)
        if self.asked is None:
            return pairs
        asked = self._code(self.asked).unique()
        for _ in range(_ATTEMPTS):
            again = torch.isin(self._code(pairs), asked)
            if not bool(again.any()):
                return pairs
            pairs[again] = self._draw(int(again.sum()), generator)
        raise ValueError(
            f"(nearly) all pairs of the {self._size()} segments to evaluate on were asked in "
            f"training ({len(asked)} different ones), which leaves none to evaluate with; collect "
            "more segments (data.segments), or ask about fewer pairs (raters.count, "
            "raters.answers)"
        )

    @property
    def num_pairs(self) -> int:
        """Different pairs that can be drawn."""
        start = torch.zeros(self.num_segments) if self.start is None else self.start
        start = start if self.allowed is None else start[self.allowed]
        each = start.unique(return_counts=True)[1]
        found = int((each * (each - 1) // 2).sum())
        if self.asked is None:
            return found
        asked = self.asked
        if self.start is not None:
            asked = asked[self.start[asked[:, 0]] == self.start[asked[:, 1]]]
        if self.allowed is not None:
            asked = asked[torch.isin(asked, self.allowed).all(1)]
        return found - len(self._code(asked).unique())

    def _size(self) -> int:
        return self.num_segments if self.allowed is None else len(self.allowed)

    def _draw(self, num_pairs: int, generator: torch.Generator) -> Tensor:
        start = self.start
        if start is not None and self.allowed is not None:
            start = start[self.allowed]
        pairs = draw_pairs(self._size(), num_pairs, start=start, generator=generator)
        return pairs if self.allowed is None else self.allowed[pairs]

    def _code(self, pairs: Tensor) -> Tensor:
        """One number for each pair, ``[M]``, the same in either order."""
        return pairs.amin(-1) * self.num_segments + pairs.amax(-1)


def training_pool(segments: TensorDictBase) -> PairPool:
    """Pairs that raters are asked about for training.

    Args:
        segments: TensorDict ``[N, T]``.

    Raises:
        ValueError: If there are fewer than three starts.
    """
    start = starts_of(segments)
    if start is None:
        return PairPool(len(segments))
    return PairPool(len(segments), start, (~_is_held_out(start)).nonzero()[:, 0])


def held_out_pool(segments: TensorDictBase, asked: Tensor) -> PairPool:
    """Pairs to evaluate on, none of which was asked in training.

    Where segments say which state they go on from, all pairs of the starts that ``training_pool``
    leaves out, so that not even a segment was shown. ``asked`` matters there
    too: loaded preferences may be about any segments.

    Args:
        segments: TensorDict ``[N, T]``.
        asked: Pairs that were asked in training, ``[M, 2]``.

    Raises:
        ValueError: If there are fewer than three starts.
    """
    start = starts_of(segments)
    allowed = None if start is None else _is_held_out(start).nonzero()[:, 0]
    return PairPool(len(segments), start, allowed, asked)


def _is_held_out(start: Tensor) -> Tensor:
    """Whether each segment's start is kept for evaluation, bool ``[N]``.

    The last ones are: starts that follow each other may come from one episode, and this way hardly
    any episode is on both sides.
    """
    starts = start.unique()  # sorted
    count = max(_FEWEST_HELD_OUT, round(_HELD_OUT_SHARE * len(starts)))
    if len(starts) <= count:
        raise ValueError(
            f"segments must go on from at least {count + 1} starts, of which {count} are kept for "
            f"evaluation, got {len(starts)}; collect more segments (data.segments)"
        )
    kept: Tensor = start >= starts[-count]
    return kept
