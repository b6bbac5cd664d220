"""Tidy rows of what came out, in the making and done."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.best_of_set import coverage, lowest
from popl_rl.evaluation.measures import (
    episode_returns,
    group_returns,
    info_rates,
    mean_and_peak,
    recovery,
    steps_to_success,
    success_rate,
)
from popl_rl.evaluation.optimum import Scale
from popl_rl.evaluation.protocol import MeasuredInfos
from popl_rl.evaluation.statistics import RESULT_COLUMNS
from popl_rl.keys import REWARD
from popl_rl.raters.groups import RaterGroup

__all__ = ["Performance", "Rows", "Scoreboard", "Served", "weighted_quantile"]

_LEVEL = 0.1  # share of the raters who get less than the quantile over raters


@dataclass(frozen=True)
class Scoreboard:
    """What came out.

    Attributes:
        results: Tidy rows ``method, choice, group, measure, value``.
        catered: Member that a first new rater of each group was given, by group name.
        episodes: Episodes ``[1, E, H]`` behind the pictures, by method and group name.
        label: Name of the method whose set was evaluated.
        served: Members of its set that were rolled out; None where nobody acted.
    """

    results: pd.DataFrame
    catered: dict[str, int]
    episodes: dict[tuple[str, str], TensorDict]
    label: str = "popl"
    served: "Served | None" = None

    def value(self, method: str, group: str, measure: str, choice: str | None = None) -> float:
        """One number of the table.

        Args:
            method: Value of the column ``method``.
            group: Name of a group, or ``all``.
            measure: What was measured.
            choice: How the hypothesis was chosen; the method's first choice if None.

        Raises:
            KeyError: If there is no such row.
        """
        rows = self.results
        chosen = rows[(rows.method == method) & (rows.group == group) & (rows.measure == measure)]
        if choice is not None:
            chosen = chosen[chosen.choice == choice]
        if chosen.empty:
            raise KeyError(f"no row has {method=}, {group=}, {measure=} and {choice=}")
        return float(chosen.value.iloc[0])


@dataclass(frozen=True)
class Performance:
    """What P hypotheses do.

    Attributes:
        episodes: ``[P, E, H]``.
        exact: Exact return of each to each group, ``[P, G]``; None where the optimum is unknown.
        greedy: The same of always taking the most likely action; None without a transition table.
    """

    episodes: TensorDict
    exact: Tensor | None
    greedy: Tensor | None = None

    def one(self, index: int) -> "Performance":
        """The performance of one hypothesis alone."""
        rows = slice(index, index + 1)
        returns = [None if own is None else own[rows] for own in (self.exact, self.greedy)]
        return Performance(self.episodes[rows], *returns)


@dataclass(frozen=True)
class Served:
    """Members that were rolled out, and who was given which.

    Attributes:
        picks: Member of each new rater ``[G, raters]``, by kind of catering.
        members: Members that were rolled out.
        performance: What these do.
        fair: The fair choice.
    """

    picks: dict[str, Tensor]
    members: list[int]
    performance: Performance
    fair: int

    def share(self, index: int, picks: Tensor) -> Tensor:
        """Share of a group's new raters that are given each of the members rolled out."""
        given = (picks[index].unsqueeze(1) == torch.tensor(self.members)).float()
        return given.mean(0)


class Rows:
    """Tidy rows ``method, choice, group, measure, value`` in the making.

    Args:
        groups: G groups.
        infos: Which infos mean success and doors, and which are measured.
        floor: Return to each group that is a recovery of 0, ``[G]``.
        oracle: Return of each group's oracle, ``[G]``; NaN where it is unknown.
        exact: Knows the optimum of each group; None where nobody does.
        shares: Chance that a rater is of each group; equal if None.
    """

    def __init__(
        self,
        groups: Sequence[RaterGroup],
        infos: MeasuredInfos,
        *,
        floor: Tensor,
        oracle: Tensor,
        exact: Scale | None = None,
        shares: Sequence[float] | None = None,
    ) -> None:
        self.groups, self.infos = groups, infos
        self.floor, self.oracle, self.exact = floor, oracle, exact
        self.shares = [1 / len(groups)] * len(groups) if shares is None else shares
        self.rows: list[tuple[str, str, str, str, float]] = []
        # What each rater is given: values and weights by measure and entry.
        self._each: dict[tuple[str, tuple[str, str]], list[tuple[Tensor, Tensor]]] = {}

    def returns(self, episodes: TensorDict) -> Tensor:
        """Mean return of P hypotheses to every group, ``[P, G]``; see ``group_returns``."""
        return group_returns(episodes, self.groups)

    def add(
        self,
        entry: tuple[str, str],
        index: int,
        done: Performance,
        share: Tensor,
        *,
        raters: int | None = None,
    ) -> None:
        """What a method does for one group.

        Args:
            entry: Method and choice.
            index: Index of the group.
            done: What P hypotheses do.
            share: How much each of them counts, ``[P]``.
            raters: Number of raters that the shares are of, if they are a sample.
        """
        rolled = done.episodes
        returns = episode_returns(rolled, self.groups)
        value = float(returns.mean(1)[:, index] @ share)
        self.add_return(entry, index, value, error=_error(returns[..., index], share, raters))
        if REWARD in rolled.keys() and rolled.shape[-1] > 1:  # noqa: SIM118 - not a dict
            reward = (rolled[REWARD] * rolled[MASK]).sum(-1).mean(-1)
            self.add_value(entry, index, "reward", float(reward @ share))
            length = rolled[MASK].sum(-1).float().mean(-1)
            self.add_value(entry, index, "length", float(length @ share))
        for prefix, exact in (("", done.exact), ("greedy_", done.greedy)):
            if exact is not None:
                own = exact[:, index]
                self.add_share(entry, index, float(own @ share.double()), prefix=prefix)
                of_each = [self._share_of_optimum(index, value) for value in own.tolist()]
                measure = f"{prefix}share_of_optimum"
                self._keep(measure, entry, index, torch.tensor(of_each, dtype=torch.float64), share)
        success = float(success_rate(rolled, self.infos.success) @ share)
        self.add_value(entry, index, "success", success)
        if self.infos.measured:
            steps = float(steps_to_success(rolled, self.infos.success) @ share)
            self.add_value(entry, index, "steps", steps)
        for name in self.infos.measured:
            for what, values in zip(("mean", "peak"), mean_and_peak(rolled, name), strict=True):
                self.add_value(entry, index, f"{what}_{name}", float(values @ share))
        if self.infos.door is not None:
            for door, rate in info_rates(rolled, self.infos.door).items():
                if door >= 0:
                    self.add_value(entry, index, f"{self.infos.door}_{door}", float(rate @ share))

    def recovery(self, index: int, value: float) -> float:
        """What a return to a group is between the floor and the group's oracle."""
        low, high = float(self.floor[index]), float(self.oracle[index])
        return recovery(value, reference=low, oracle=high)

    def add_return(
        self,
        entry: tuple[str, str],
        index: int,
        value: float,
        *,
        prefix: str = "",
        error: float | None = None,
    ) -> None:
        """A mean return of episodes to one group, its standard error, and the recovery it is."""
        self.add_value(entry, index, f"{prefix}return", value)
        if error is not None:
            self.add_value(entry, index, f"{prefix}return_error", error)
        self.add_value(entry, index, f"{prefix}recovery", self.recovery(index, value))

    def add_share(
        self,
        entry: tuple[str, str],
        index: int,
        value: float,
        *,
        prefix: str = "",
        suffix: str = "",
    ) -> None:
        """The share of the optimum that an exact return to one group is."""
        share = self._share_of_optimum(index, value)
        self.add_value(entry, index, f"{prefix}share_of_optimum{suffix}", share)

    def _share_of_optimum(self, index: int, value: float) -> float:
        if self.exact is None:
            raise ValueError("exact must be given to tell shares of the optimum, got None")
        return self.exact.share_of_optimum(index, value)

    def add_accuracy(
        self, entry: tuple[str, str], index: int, *, catered: Tensor, best: float
    ) -> None:
        """How well a method ranks for one group: what is given, and the best of its set.

        Args:
            entry: Method and choice.
            index: Index of the group.
            catered: Accuracy of what each of R raters of the group is given, ``[R]``.
            best: Accuracy of the best of the set.
        """
        self.add_value(entry, index, "accuracy", float(catered.mean()))
        self.add_value(entry, index, "best_accuracy", best)
        self._keep("accuracy", entry, index, catered, torch.ones(len(catered)) / len(catered))

    def _keep(
        self, measure: str, entry: tuple[str, str], index: int, values: Tensor, weights: Tensor
    ) -> None:
        """Remember what single raters of a group are given, weights of whom sum to 1."""
        kept = values.double(), weights.double() * self.shares[index]
        self._each.setdefault((measure, entry), []).append(kept)

    def add_value(self, entry: tuple[str, str], index: int, measure: str, value: float) -> None:
        """Any number about a method, a choice and a group."""
        self.rows.append((*entry, self.groups[index].name, measure, value))

    def add_whole(self, entry: tuple[str, str], measure: str, value: float) -> None:
        """Any number about a method and all groups together."""
        self.rows.append((*entry, "all", measure, value))

    def add_worst(self) -> None:
        """What each method's recoveries, and shares of the optimum, of all groups come to.

        Beside the worst group also the 10 % quantile over raters, each group's in its share.
        """
        found: dict[tuple[str, tuple[str, str]], list[float]] = {}
        for method, choice, _, measure, value in self.rows:
            if measure in ("recovery", "share_of_optimum", "greedy_share_of_optimum"):
                found.setdefault((measure, (method, choice)), []).append(value)
        for (measure, entry), of_groups in found.items():
            self.add_whole(entry, f"worst_{measure}", lowest(of_groups))
            if measure == "recovery":
                self.add_whole(entry, "coverage", coverage(of_groups))
        for (measure, entry), kept in self._each.items():
            values, weights = (torch.cat(part) for part in zip(*kept, strict=True))
            quantile = weighted_quantile(values, weights, level=_LEVEL)
            self.add_whole(entry, f"rater_quantile_{measure}", quantile)

    def table(self) -> pd.DataFrame:
        """The rows so far, as a table."""
        return pd.DataFrame(self.rows, columns=RESULT_COLUMNS)


def weighted_quantile(values: Tensor, weights: Tensor, *, level: float) -> float:
    """Lowest value such that this one and those below have at least a share of all weight.

    Args:
        values: ``[R]``.
        weights: How much each counts, ``[R]``, not negative; those of weight 0 do not count.
        level: The share, in (0, 1].

    Returns:
        One of the values; NaN if one that counts is unknown.
    """
    counts = weights > 0
    ordered, order = values[counts].sort()
    if bool(ordered.isnan().any()):
        return float("nan")
    below = weights[counts][order].cumsum(0)
    # Sums of weights such as ten times 0.1 fall short of their whole in the last digits.
    return float(ordered[below >= level * below[-1] - 1e-9][0])


def _error(returns: Tensor, share: Tensor, raters: int | None) -> float:
    """Standard error of a mean return, from episodes ``[P, E]`` and from who was asked.

    Episode e starts alike for all hypotheses, so that episodes, not members, are what is drawn;
    raters are drawn independently of them. NaN with a single episode.
    """
    episodes = share @ returns
    squared = episodes.var() / len(episodes) if len(episodes) > 1 else torch.tensor(torch.nan)
    if raters is not None:
        own = returns.mean(1)
        squared = squared + share @ (own - share @ own).square() / raters
    return float(squared.sqrt())
