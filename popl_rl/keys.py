"""Every TensorDict key of the package with its shape, in one table.

Segments, batch size ``[N]`` (N segments of T steps):

| key | shape | dtype | what |
|---|---|---|---|
| ``observation`` | ``[N, T, O]`` | float32 | what the policy sees before each step |
| ``action`` | ``[N, T]`` or ``[N, T, A]`` | int64 or float32 | what was done |
| ``reward`` | ``[N, T]`` | float32 | the environment's own reward, for raters that use it |
| ``("info", name)`` | ``[N, T]`` | float32 or int64 | each number of the ``info`` |
| ``mask`` | ``[N, T]`` | bool | optional: steps that there are, where segments differ in length |
| ``("info", "start")`` | ``[N, T]`` | int64 | which segments may be compared, see ``START`` |

Preferences, batch size ``[M]``:

| key | shape | dtype | what |
|---|---|---|---|
| ``pair`` | ``[M, 2]`` | int64 | rows of the two segments that were compared |
| ``answer`` | ``[M]`` | int64 | an ``Answer`` |
| ``rater`` | ``[M]`` | int64 | id of the person who answered; -1 where it is unknown |
| ``chance`` | ``[M]`` | float32 | optional soft label: how likely the second is preferred |
| ``ranking`` | ``[M]`` | int64 | optional: which ranking it is part of; -1 for a comparison |
| ``("hidden", "group")`` | ``[M]`` | int64 | group of that person. For evaluation only |
| ``("hidden", "utility")`` | ``[M, 2]`` | float32 | utility of each segment. For evaluation only |
| ``("hidden", "condition")`` | ``[M]`` | int64 | what people were told. For evaluation only |
"""

from enum import IntEnum

from tensordict.utils import NestedKey

OBSERVATION = "observation"
ACTION = "action"
REWARD = "reward"
INFO = "info"
MASK = "mask"
PAIR = "pair"
ANSWER = "answer"
RATER = "rater"
CHANCE = "chance"
#: A ranking of n items is the comparisons of each item with all behind it. Those that prefer the
#: same item are one choice out of several, a stage of the Plackett-Luce model.
RANKING = "ranking"
HIDDEN = "hidden"
GROUP = (HIDDEN, "group")
UTILITY = (HIDDEN, "utility")
CONDITION = (HIDDEN, "condition")
#: Optional number of the state that a segment goes on from. Where it is given, only segments from
#: the same state are compared: of two clips that begin alike, what differs is what was done.
START = (INFO, "start")

SEGMENT_KEYS: tuple[NestedKey, ...] = (OBSERVATION, ACTION, REWARD, INFO)
#: What a learner may read of a preference.
LEARNER_KEYS: tuple[NestedKey, ...] = (PAIR, ANSWER, RATER)
#: What only an evaluation may read.
HIDDEN_KEYS: tuple[NestedKey, ...] = (GROUP, UTILITY)


class Answer(IntEnum):
    """What a rater said about a pair.

    The first two are the position, in ``pair``, of the segment that is preferred; no number of a
    segment, and no sign of who won.
    """

    FIRST = 0
    SECOND = 1
    TIE = 2
    SKIP = 3
