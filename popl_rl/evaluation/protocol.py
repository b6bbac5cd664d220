"""How a set is evaluated: how much is asked, and what is read off the environment's infos."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

__all__ = ["EvaluationProtocol", "MeasuredInfos"]


@dataclass(frozen=True)
class EvaluationProtocol:
    """How many answers, raters and pairs an evaluation takes.

    Attributes:
        answers: Answers of each new rater that the set is catered to.
        new_raters: New raters of each group.
        curve: Numbers of answers that catering is measured at besides; empty for none.
        curve_members: Members that are rolled out for these curves at most.
        pairs: Held-out pairs of each group, for accuracies.
        reference: Whose return is a recovery of 0: random actions, a clone of the data's typical
            behaviour, or the oracle of whichever other group suits a group least.
    """

    answers: int = 20
    new_raters: int = 20
    curve: Sequence[int] = ()
    curve_members: int = 40
    pairs: int = 4000
    reference: Literal["random", "clone", "others"] = "random"


@dataclass(frozen=True)
class MeasuredInfos:
    """Which numbers in the environment's info have rows in the table.

    Attributes:
        success: Info that is positive when the task is done.
        door: Integer info, such as a door, each of whose values has a rate; None for none.
        measured: Infos whose mean and peak have rows.
    """

    success: str = "goal"
    door: str | None = None
    measured: Sequence[str] = ()
