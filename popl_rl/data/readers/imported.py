"""What a reader gives: segments, preferences, and the names that people and things had."""

from typing import NamedTuple

from tensordict import TensorDict, TensorDictBase

__all__ = ["Imported", "Names"]


class Names(NamedTuple):
    """What the numbers in preferences stand for; empty where there are no names.

    Attributes:
        items: Name of each segment.
        raters: Name of each rater.
        conditions: Name of each condition.
        texts: Text of each segment, where segments are texts.
    """

    items: list[str] = []
    raters: list[str] = []
    conditions: list[str] = []
    texts: list[str] = []


class Imported(NamedTuple):
    """What a reader found. The first two are what training reads.

    Attributes:
        segments: TensorDict ``[N, T]`` with ``observation`` and ``action``, and ``mask`` where
            segments differ in length. Texts without features have observations of width 0.
        preferences: TensorDict ``[M]``, see `popl_rl.keys`.
        names: What the numbers stand for.
    """

    segments: TensorDictBase
    preferences: TensorDict
    names: Names = Names()
