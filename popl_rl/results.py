"""The scoreboard of a run: every method, every group, every measure, in tidy rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.acting import Acting, Choosing, Optimising, Planning, Rolling
from popl_rl.config import Config, EnvConfig, EvaluationConfig
from popl_rl.evaluation import (
    group_accuracy,
    group_returns,
    held_out_pairs,
    info_rates,
    mean_and_peak,
    new_rater_answers,
    recovery,
    steps_to_success,
    success_rate,
)
from popl_rl.experiment import Data, build_bank, fresh_segments, stream
from popl_rl.policies import PolicySpec
from popl_rl.policy_set import HypothesisSet, PolicySet
from popl_rl.population import segment_scores
from popl_rl.preferences import starts_of
from popl_rl.raters import RaterGroup
from popl_rl.reward_baselines import Rivals
from popl_rl.rewards import RewardSpec
from popl_rl.segments import SegmentBank
from popl_rl.worlds import World, has_nothing_to_do

__all__ = ["Judge", "Scoreboard", "make_judge"]


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


class Judge:
    """Judges hypotheses by what every hidden group wants; reads what no learner may.

    Args:
        acting: Shows what hypotheses do.
        env: Which infos mean success and doors.
        config: How many answers, raters and pairs.
        groups: G groups.
        bank: Segments to judge on.
        worth: Worth of each segment to each group, ``[G, N]``.
        start: Which segments may be compared, ``[N]``; all if None.
        reference: A policy whose return is a recovery of 0; random actions if None.
        seed: Seed of the run.
    """

    def __init__(
        self,
        acting: Acting,
        env: EnvConfig,
        config: EvaluationConfig,
        groups: Sequence[RaterGroup],
        bank: SegmentBank,
        worth: Tensor,
        *,
        start: Tensor | None = None,
        reference: HypothesisSet | None = None,
        seed: int,
    ) -> None:
        self.acting, self.env, self.config = acting, env, config
        self.groups, self.bank, self.worth = groups, bank, worth
        self.start, self.reference = start, reference
        self.seed = seed
        generator = stream(seed, "held-out pairs")
        self.pairs = {
            index: held_out_pairs(
                worth, index, count=config.pairs, start=start, generator=generator
            )
            for index in range(len(groups))
        }

    def accuracy(self, hypotheses: HypothesisSet) -> Tensor:
        """Accuracy of every hypothesis on every group's held-out pairs, ``[P, G]``."""
        scores = segment_scores(
            hypotheses.population, self.bank, alpha=hypotheses.alpha, discount=hypotheses.discount
        )
        return group_accuracy(scores.cpu(), self.pairs)

    def snapshot(self, hypotheses: HypothesisSet) -> dict[str, float]:
        """Accuracy of every hypothesis on every group, flat: ``{"<group>/<member>": value}``."""
        columns = self.accuracy(hypotheses).T.tolist()
        return {
            f"{group.name}/{member}": value
            for group, column in zip(self.groups, columns, strict=True)
            for member, value in enumerate(column)
        }

    def cater(self, hypotheses: HypothesisSet, method: str) -> Tensor:
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
                    start=self.start,
                    generator=generator,
                )
                choice = hypotheses.cater(
                    self.bank,
                    answers,
                    method=method,  # type: ignore[arg-type]
                    generator=draw,
                )
                picks.append(choice.member)
        return torch.tensor(picks).view(len(self.groups), -1)

    def score(
        self,
        hypotheses: HypothesisSet,
        baselines: HypothesisSet | None,
        *,
        rivals: Rivals | None = None,
        label: str = "popl",
    ) -> Scoreboard:
        """Fill the scoreboard.

        Args:
            hypotheses: The set that was found.
            baselines: One trained on everybody's answers, then one oracle per group; None to leave
                them, and with them ``recovery``, out.
            rivals: Other learners of reward functions, for :class:`~popl_rl.acting.Choosing` alone.
            label: Name of the method that found ``hypotheses``.
        """
        random = self.acting(None)
        base = None if baselines is None else self.acting(baselines)
        oracle = None if base is None else group_returns(base[1:], self.groups).diagonal()
        reference = random if self.reference is None else self.acting(self.reference)
        rows = _Rows(self.groups, self.env, reference=reference, oracle=oracle)
        catered: dict[str, int] = {}
        episodes: dict[tuple[str, str], TensorDict] = {}
        sets = {label: hypotheses} | ({} if rivals is None else {"brex": rivals.brex})
        for whose, found in sets.items():
            accuracy = self.accuracy(found)
            for method in ("posterior", "lexicase"):
                name = whose if method == "posterior" else f"{whose}_lexicase"
                picks = self.cater(found, method)
                used, position = picks.unique(return_inverse=True)
                rolled = self.acting(found.subset(used.tolist()))
                for index, group in enumerate(self.groups):
                    share = position[index].bincount(minlength=len(used)).float()
                    mean = float(accuracy[picks[index], index].mean())
                    rows.add(name, index, rolled, share / share.sum())
                    rows.add_accuracy(name, index, mean, float(accuracy[:, index].max()))
                    if name == label:
                        favourite = int(share.argmax())
                        catered[group.name] = int(used[favourite])
                        episodes[name, group.name] = rolled[favourite : favourite + 1]
        if baselines is not None and base is not None:
            accuracy, one = self.accuracy(baselines), torch.ones(1)
            pooled = "cpl" if isinstance(baselines, PolicySet) else "bradley_terry"
            for index, group in enumerate(self.groups):
                for name, row in ((pooled, 0), ("oracle", 1 + index)):
                    rows.add(name, index, base[row : row + 1], one)
                    value = float(accuracy[row, index])
                    rows.add_accuracy(name, index, value, value)
                    episodes[name, group.name] = base[row : row + 1]
        if rivals is not None:
            self._score_distributional(rivals, rows)
        for index in range(len(self.groups)):
            if self.reference is not None:
                rows.add("clone", index, reference, torch.ones(1))
            rows.add("random", index, random, torch.ones(1))
        results = pd.DataFrame(rows.rows, columns=["method", "group", "measure", "value"])
        return Scoreboard(results, catered, episodes, label)

    def _score_distributional(self, rivals: Rivals, rows: "_Rows") -> None:
        assert isinstance(self.acting, Choosing)
        for label, score in rivals.scores(self.bank).items():
            chosen = self.acting.choose(score.cpu().unsqueeze(0))
            accuracy = group_accuracy(score.cpu().unsqueeze(0), self.pairs)[0].tolist()
            for index, value in enumerate(accuracy):
                rows.add(label, index, chosen, torch.ones(1))
                rows.add_accuracy(label, index, value, value)
        for kind, model in rivals.dpl.items():
            context = model.hidden_context(self.bank)
            rows.rows.append((f"dpl_{kind}", "all", "hidden_context", context))


class _Rows:
    """Tidy rows in the making."""

    def __init__(
        self,
        groups: Sequence[RaterGroup],
        env: EnvConfig,
        *,
        reference: TensorDict,
        oracle: Tensor | None,
    ) -> None:
        self.groups, self.env = groups, env
        self.reference = group_returns(reference, groups)[0]
        self.oracle = torch.full_like(self.reference, float("nan")) if oracle is None else oracle
        self.rows: list[tuple[str, str, str, float]] = []

    def add(self, method: str, index: int, rolled: TensorDict, share: Tensor) -> None:
        """What a method does for one group: policies ``[P, E, H]``, weighted by ``share``."""
        group = self.groups[index].name
        value = float(group_returns(rolled, self.groups)[:, index] @ share)
        low, high = float(self.reference[index]), float(self.oracle[index])
        self.rows.append((method, group, "return", value))
        self.rows.append((method, group, "recovery", recovery(value, reference=low, oracle=high)))
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

    def add_accuracy(self, method: str, index: int, catered: float, best: float) -> None:
        """How well a method ranks for one group."""
        group = self.groups[index].name
        self.rows.append((method, group, "accuracy", catered))
        self.rows.append((method, group, "best_accuracy", best))


def make_judge(
    config: Config,
    world: World,
    groups: tuple[RaterGroup, ...],
    data: Data,
    spec: PolicySpec | RewardSpec,
    *,
    reference: HypothesisSet | None = None,
    seed: int,
) -> Judge:
    """The judge that fits what is learnt and where.

    Policies are rolled out. Reward functions are planned for or optimised by PPO, and rolled out;
    where there is nothing to do they choose from menus of fresh segments.

    Args:
        config: The run's configuration.
        world: Where policies act.
        groups: G groups.
        data: Segments, and their worth.
        spec: Sizes of the hypotheses.
        reference: A policy whose return is a recovery of 0; random actions if None.
        seed: Seed of the evaluation.

    Raises:
        ValueError: If planning is asked for without a transition table.
    """
    device, options = config.device, config.evaluation
    if has_nothing_to_do(world.env):
        segments = fresh_segments(config.data, world, seed=seed, env=config.env)
        bank = build_bank(segments, spec).to(device)
        worth = torch.stack([group.worth(segments) for group in groups])
        chooser = Choosing(segments, bank, options, seed=seed)
        return Judge(chooser, config.env, options, groups, bank, worth, seed=seed)
    bank = build_bank(data.steps, spec).to(device)
    acting: Acting = Rolling(world, config.env, options, seed=seed)
    if isinstance(spec, RewardSpec):
        can_plan = world.table is not None and options.optimiser != "ppo"
        if can_plan or options.optimiser == "plan":
            acting = Planning(world, config.env, options, seed=seed)
        else:
            acting = Optimising(world, config.env, options, seed=seed, bank=bank)
    return Judge(
        acting,
        config.env,
        options,
        groups,
        bank,
        data.worth,
        start=starts_of(data.steps),
        reference=reference,
        seed=seed,
    )
