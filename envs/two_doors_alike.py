"""Rater groups of the two doors that want more or less the same, for sweeps over agreement.

They are ``upper`` and ``lower`` with a smaller fine for the other door: where a detour costs about
as much, people agree on most pairs. Names say on how many: ``upper_70`` and ``lower_70`` by regret
order some 70 % of random pairs of the default segments in the same way (a test measures it);
``upper`` and ``lower`` 38 %. Refer to them as ``popl_rl.envs.two_doors_alike:upper_70``.
"""

from collections.abc import Callable

from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.keys import INFO

__all__ = ["FINES"]

FINES = {50: 0.575, 60: 0.445, 70: 0.32, 80: 0.195, 90: 0.087}
"""Fine for walking through the other door, by percent of pairs that both groups order alike."""

_STEP_COST = 0.02


def _wants(name: str, own: int, percent: int) -> Callable[[TensorDictBase], Tensor]:
    def utility(segments: TensorDictBase) -> Tensor:
        door: Tensor = segments[INFO, "door"]
        another = (door >= 0) & (door != own)
        goal: Tensor = segments[INFO, "goal"]
        return goal.float() - _STEP_COST - FINES[percent] * another.float()

    utility.__name__ = f"{name}_{percent}"
    utility.__doc__ = f"Want the goal soon, and as a rule by door {own}."
    return utility


upper_50, lower_50 = _wants("upper", 0, 50), _wants("lower", 1, 50)
upper_60, lower_60 = _wants("upper", 0, 60), _wants("lower", 1, 60)
upper_70, lower_70 = _wants("upper", 0, 70), _wants("lower", 1, 70)
upper_80, lower_80 = _wants("upper", 0, 80), _wants("lower", 1, 80)
upper_90, lower_90 = _wants("upper", 0, 90), _wants("lower", 1, 90)
