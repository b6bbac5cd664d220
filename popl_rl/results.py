"""The scoreboard of a run: every method, every group, every measure, in tidy rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.config import EnvConfig, EvaluationConfig
from popl_rl.evaluation import (
    group_accuracy,
    group_returns,
    held_out_pairs,
    info_rates,
    new_rater_answers,
    recovery,
    roll_out,
    success_rate,
)
from popl_rl.experiment import World, stream
from popl_rl.policy_set import PolicySet
from popl_rl.population import segment_scores
from popl_rl.raters import RaterGroup
from popl_rl.segments import SegmentBank, random_behaviour

__all__ = ["Judge", "Scoreboard"]


@dataclass(frozen=True)
class Scoreboard:
    """What came out.

    Attributes:
        results: Tidy rows ``method, group, measure, value``.
        catered: Member that a first new rater of each group was given, by group name.
        episodes: Episodes ``[1, E, H]`` behind the pictures, by method and group name.
    """

    results: pd.DataFrame
    catered: dict[str, int]
    episodes: dict[tuple[str, str], TensorDict]

    def value(self, method: str, group: str, measure: str) -> float:
        """One number of the table."""
        rows = self.results
        chosen = rows[(rows.method == method) & (rows.group == group) & (rows.measure == measure)]
        return float(chosen.value.iloc[0])


class Judge:
    """Judges policies by what every hidden group wants; reads what no learner may.

    Args:
        world: Where to roll out.
        env: Episode length, and which infos mean success and doors.
        config: How many episodes, answers and pairs.
        groups: G groups.
        bank: The stored segments.
        worth: Worth of each segment to each group, ``[G, N]``.
        seed: Seed of the run.
    """

    def __init__(
        self,
        world: World,
        env: EnvConfig,
        config: EvaluationConfig,
        groups: Sequence[RaterGroup],
        bank: SegmentBank,
        worth: Tensor,
        *,
        seed: int,
    ) -> None:
        self.world, self.env, self.config = world, env, config
        self.groups, self.bank, self.worth = groups, bank, worth
        self.seed = seed
        generator = stream(seed, "held-out pairs")
        self.pairs = {
            index: held_out_pairs(worth, index, count=config.pairs, generator=generator)
            for index in range(len(groups))
        }

    def accuracy(self, policies: PolicySet) -> Tensor:
        """Accuracy of every policy on every group's held-out pairs, ``[P, G]``."""
        scores = segment_scores(
            policies.population, self.bank, alpha=policies.alpha, discount=policies.discount
        )
        return group_accuracy(scores.cpu(), self.pairs)

    def snapshot(self, policies: PolicySet) -> dict[str, float]:
        """Accuracy of every policy on every group, flat: ``{"<group>/<policy>": value}``."""
        columns = self.accuracy(policies).T.tolist()
        return {
            f"{group.name}/{policy}": value
            for group, column in zip(self.groups, columns, strict=True)
            for policy, value in enumerate(column)
        }

    def cater(self, policies: PolicySet, method: str) -> Tensor:
        """Member given to each of several new raters of each group, ``[G, raters]``."""
        picks = []
        for index in range(len(self.groups)):
            # The same new raters, pairs and answers whatever is being judged.
            generator = stream(self.seed, f"new raters/{index}")
            draw = stream(self.seed, f"lexicase catering/{index}")
            for _ in range(self.config.new_raters):
                answers = new_rater_answers(
                    self.groups,
                    index,
                    self.worth,
                    answers=self.config.answers,
                    generator=generator,
                )
                choice = policies.cater(
                    self.bank,
                    answers,
                    method=method,  # type: ignore[arg-type]
                    generator=draw,
                )
                picks.append(choice.member)
        return torch.tensor(picks).view(len(self.groups), -1)

    def roll_out(self, policies: PolicySet | None) -> TensorDict:
        """Episodes of every policy, or of the uniformly random one, ``[P, E, H]``."""
        return roll_out(
            self.world.make,
            policies,
            episodes=self.config.episodes,
            max_steps=self.env.max_steps,
            seed=self.seed,
            greedy=self.config.greedy,
            random_action=random_behaviour(self.world.env.action_space),
        )

    def score(self, policies: PolicySet, baselines: PolicySet | None) -> Scoreboard:
        """Fill the scoreboard.

        Args:
            policies: The policy set.
            baselines: Pooled CPL, then one oracle per group; None to leave them, and with them
                ``recovery``, out.
        """
        rows: list[tuple[str, str, str, float]] = []
        episodes: dict[tuple[str, str], TensorDict] = {}
        rolled_random = self.roll_out(None)
        random = group_returns(rolled_random, self.groups)[0]
        oracle = torch.full_like(random, float("nan"))
        base = None if baselines is None else self.roll_out(baselines)
        if base is not None:
            oracle = group_returns(base[1:], self.groups).diagonal()

        def add(method: str, index: int, rolled: TensorDict, share: Tensor) -> None:
            """Rows of one method and group: rolled policies, weighted by ``share``."""
            group = self.groups[index].name
            value = float(group_returns(rolled, self.groups)[:, index] @ share)
            rows.append((method, group, "return", value))
            recovered = recovery(value, random=float(random[index]), oracle=float(oracle[index]))
            rows.append((method, group, "recovery", recovered))
            success = float(success_rate(rolled, self.env.success) @ share)
            rows.append((method, group, "success", success))
            if self.env.door is not None:
                for door, rate in info_rates(rolled, self.env.door).items():
                    if door >= 0:
                        name = f"{self.env.door}_{door}"
                        rows.append((method, group, name, float(rate @ share)))

        def add_accuracy(method: str, index: int, catered: float, best: float) -> None:
            group = self.groups[index].name
            rows.append((method, group, "accuracy", catered))
            rows.append((method, group, "best_accuracy", best))

        accuracy = self.accuracy(policies)
        catered: dict[str, int] = {}
        for label, method in (("popl", "posterior"), ("popl_lexicase", "lexicase")):
            picks = self.cater(policies, method)
            used, position = picks.unique(return_inverse=True)
            rolled = self.roll_out(policies.subset(used.tolist()))
            for index, group in enumerate(self.groups):
                share = position[index].bincount(minlength=len(used)).float()
                add(label, index, rolled, share / share.sum())
                mean = float(accuracy[picks[index], index].mean())
                add_accuracy(label, index, mean, float(accuracy[:, index].max()))
                if label == "popl":
                    favourite = int(share.argmax())
                    catered[group.name] = int(used[favourite])
                    episodes[label, group.name] = rolled[favourite : favourite + 1]
        if baselines is not None and base is not None:
            base_accuracy, one = self.accuracy(baselines), torch.ones(1)
            for index, group in enumerate(self.groups):
                for label, row in (("cpl", 0), ("oracle", 1 + index)):
                    add(label, index, base[row : row + 1], one)
                    value = float(base_accuracy[row, index])
                    add_accuracy(label, index, value, value)
                    episodes[label, group.name] = base[row : row + 1]
        for index in range(len(self.groups)):
            add("random", index, rolled_random, torch.ones(1))
        results = pd.DataFrame(rows, columns=["method", "group", "measure", "value"])
        return Scoreboard(results, catered, episodes)
