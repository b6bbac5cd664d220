"""Tidy rows of what came out, in the making and done."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.config import EnvConfig
from popl_rl.evaluation.best_of_set import coverage, lowest
from popl_rl.evaluation.measures import (
    group_returns,
    info_rates,
    mean_and_peak,
    recovery,
    steps_to_success,
    success_rate,
)
from popl_rl.raters.groups import RaterGroup

__all__ = ["Rows", "Scoreboard", "Served"]


@dataclass(frozen=True)
class Scoreboard:
    """What came out.

    Attributes:
        results: Tidy rows ``method, group, measure, value``.
        catered: Member that a first new rater of each group was given, by group name.
        episodes: Episodes ``[1, E, H]`` behind the pictures, by method and group name.
        label: Name of the method whose set was judged.
    """

    results: pd.DataFrame
    catered: dict[str, int]
    episodes: dict[tuple[str, str], TensorDict]
    label: str = "popl"

    def value(self, method: str, group: str, measure: str) -> float:
        """One number of the table."""
        rows = self.results
        chosen = rows[(rows.method == method) & (rows.group == group) & (rows.measure == measure)]
        return float(chosen.value.iloc[0])


@dataclass(frozen=True)
class Served:
    """Members that were rolled out, and who was given which.

    Attributes:
        picks: Member of each new rater ``[G, raters]``, by kind of catering.
        members: Members that were rolled out.
        rolled: Their episodes, ``[len(members), E, H]``.
        fair: The fair choice.
    """

    picks: dict[str, Tensor]
    members: list[int]
    rolled: TensorDict
    fair: int

    def share(self, index: int, picks: Tensor) -> Tensor:
        """Share of a group's new raters that are given each of the members rolled out."""
        given = (picks[index].unsqueeze(1) == torch.tensor(self.members)).float()
        return given.mean(0)


class Rows:
    """Tidy rows in the making.

    Args:
        groups: G groups.
        env: Which infos mean success and doors, and which are measured.
        floor: Return to each group that is a recovery of 0, ``[G]``.
        oracle: Return of each group's oracle, ``[G]``; NaN where it is unknown.
    """

    def __init__(
        self, groups: Sequence[RaterGroup], env: EnvConfig, *, floor: Tensor, oracle: Tensor
    ) -> None:
        self.groups, self.env = groups, env
        self.floor, self.oracle = floor, oracle
        self.rows: list[tuple[str, str, str, float]] = []

    def add(self, method: str, index: int, rolled: TensorDict, share: Tensor) -> None:
        """What a method does for one group: policies ``[P, E, H]``, weighted by ``share``."""
        group = self.groups[index].name
        value = float(group_returns(rolled, self.groups)[:, index] @ share)
        self.add_return(method, index, "", value)
        success = float(success_rate(rolled, self.env.success) @ share)
        self.rows.append((method, group, "success", success))
        if self.env.measured:
            steps = float(steps_to_success(rolled, self.env.success) @ share)
            self.rows.append((method, group, "steps", steps))
        for name in self.env.measured:
            for what, values in zip(("mean", "peak"), mean_and_peak(rolled, name), strict=True):
                self.rows.append((method, group, f"{what}_{name}", float(values @ share)))
        if self.env.door is not None:
            for door, rate in info_rates(rolled, self.env.door).items():
                if door >= 0:
                    name = f"{self.env.door}_{door}"
                    self.rows.append((method, group, name, float(rate @ share)))

    def recovery(self, index: int, value: float) -> float:
        """What a return to a group is between the floor and the group's oracle."""
        low, high = float(self.floor[index]), float(self.oracle[index])
        return recovery(value, reference=low, oracle=high)

    def add_return(self, method: str, index: int, prefix: str, value: float) -> None:
        """A return to one group, and the recovery that this is."""
        self.add_value(method, index, f"{prefix}return", value)
        self.add_value(method, index, f"{prefix}recovery", self.recovery(index, value))

    def add_value(self, method: str, index: int, measure: str, value: float) -> None:
        """Any number about a method and a group."""
        self.rows.append((method, self.groups[index].name, measure, value))

    def add_worst(self) -> None:
        """What each method's recoveries of all groups come to."""
        found: dict[str, list[float]] = {}
        for method, _, measure, value in self.rows:
            if measure == "recovery":
                found.setdefault(method, []).append(value)
        for method, values in found.items():
            self.rows.append((method, "all", "worst_recovery", lowest(values)))
            self.rows.append((method, "all", "coverage", coverage(values)))

    def add_accuracy(self, method: str, index: int, catered: float, best: float) -> None:
        """How well a method ranks for one group."""
        group = self.groups[index].name
        self.rows.append((method, group, "accuracy", catered))
        self.rows.append((method, group, "best_accuracy", best))
