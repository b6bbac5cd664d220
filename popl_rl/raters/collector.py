"""Preferences: which pairs are shown, to whom, and what they answer."""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Transform

from popl_rl.data.pairs import starts_of
from popl_rl.data.segments import stored_segments
from popl_rl.keys import ANSWER, GROUP, PAIR, RATER, UTILITY
from popl_rl.raters.pairs import PairPool
from popl_rl.raters.people import Raters

__all__ = ["PreferenceCollector", "collect_preferences"]


class PreferenceCollector(Transform):
    """Has raters compare pairs of stored segments, as queries are written to a replay buffer.

    Append it to the buffer that keeps preferences and extend that buffer with queries: a TensorDict
    ``[M]`` with ``rater`` (whom to ask) and, if you choose the queries yourself, ``pair``. Pairs
    that are not given are drawn uniformly from the stored segments: where these say which state
    they go on from (``popl_rl.keys.START``), from those of one state. What is written is the query
    with ``answer`` and, for evaluation only, ``("hidden", "group")`` and ``("hidden", "utility")``.

    Args:
        segments: Replay buffer of segments, one item each.
        raters: Who can be asked.
        generator: Source of the pairs and of the raters' randomness.
        pool: What pairs are drawn from; if None, all pairs of segments from one state. Pairs that
            you choose yourself may be any.

    Raises:
        ValueError: If there are fewer than two segments; when the buffer is extended, if a query
            names a rater or a segment that does not exist.

    Example:
        >>> preferences = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100), transform=PreferenceCollector(
        ...         segments, raters, generator=generator))  # doctest: +SKIP
        >>> queries = TensorDict({"rater": torch.zeros(100).long()}, [100])
        >>> preferences.extend(queries)  # doctest: +SKIP
    """

    def __init__(
        self,
        segments: TensorDictReplayBuffer,
        raters: Raters,
        *,
        generator: torch.Generator,
        pool: PairPool | None = None,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        if len(segments) < 2:
            raise ValueError(f"segments must hold at least two to compare, got {len(segments)}")
        self.segments = segments
        self.raters = raters
        self.generator = generator
        #: Worth of each segment to each group, ``[G, N]``.
        steps = stored_segments(segments)
        self.segment_utility: Tensor = raters.segment_utility(steps)
        self.pool = PairPool(len(segments), starts_of(steps)) if pool is None else pool

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        rater = tensordict[RATER]
        if not ((rater >= 0) & (rater < len(self.raters))).all():
            raise ValueError(
                f"rater must be ids in 0..{len(self.raters) - 1}, got {rater.min()}..{rater.max()}"
            )
        pair = tensordict.get(PAIR, None)
        if pair is None:
            pair = self.pool.draw(len(rater), generator=self.generator)
        elif not ((pair >= 0) & (pair < len(self.segments))).all():
            raise ValueError(
                f"pair must be segments in 0..{len(self.segments) - 1}, got {pair.min()}.."
                f"{pair.max()}"
            )
        group = self.raters.group_of[rater]
        answer = self.raters.answer(pair, rater, self.segment_utility, generator=self.generator)
        out = TensorDict({PAIR: pair, ANSWER: answer, RATER: rater}, [len(rater)])
        out[GROUP] = group
        out[UTILITY] = self.segment_utility[group.unsqueeze(-1), pair]
        return out

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Preferences are read as they were written."""
        return tensordict


def collect_preferences(
    segments: TensorDictReplayBuffer,
    raters: Raters,
    *,
    answers_per_rater: int,
    generator: torch.Generator,
    pool: PairPool | None = None,
) -> TensorDictReplayBuffer:
    """Ask every rater about the same number of random pairs.

    Args:
        segments: Replay buffer of segments, one item each.
        raters: Who is asked.
        answers_per_rater: Pairs that each rater is shown.
        generator: Source of the pairs and of the raters' randomness.
        pool: What pairs are drawn from, see ``PreferenceCollector``.

    Returns:
        Replay buffer of ``len(raters) * answers_per_rater`` preferences.

    Raises:
        ValueError: If ``answers_per_rater`` is not positive.
    """
    if answers_per_rater < 1:
        raise ValueError(f"answers_per_rater must be at least 1, got {answers_per_rater}")
    rater = torch.arange(len(raters)).repeat_interleave(answers_per_rater)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(rater)),
        transform=PreferenceCollector(segments, raters, generator=generator, pool=pool),
        batch_size=min(256, len(rater)),
    )
    buffer.extend(TensorDict({RATER: rater}, [len(rater)]))
    return buffer
