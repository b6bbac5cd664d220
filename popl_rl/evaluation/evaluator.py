"""The scoreboard of a run: every method, every group, every measure, in tidy rows.

For each group: ``return, recovery, success, accuracy, best_accuracy`` of what new raters are given
after ``evaluation.answers`` answers; ``accuracy@K`` and ``recovery@K`` after K; ``best_recovery``
of the best of the members rolled out, without the luck of the best; ``accurate_recovery`` of the
member that ranks the group's held-out pairs best (and both returns).

For the group ``all``: ``worst_recovery`` and ``coverage`` of the groups. For a set also
``distinct`` and ``effective`` members; how held_out of new raters, whose groups nobody looks at, are
met (``further_accuracy, one_for_all_accuracy, gain, gain_error, favourite_share``, see
:mod:`popl_rl.evaluation.held_out_raters`); accuracy of the fair choice of one panel for the worst rater of another
(``fair_worst_rater``) and the 10 % quantile (``fair_quantile``), and its ``fair_recovery`` for the
group that it serves worst.
"""

from collections.abc import Sequence
from functools import cached_property

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.algorithms.reward_baselines import RewardBaselines
from popl_rl.config import EnvConfig, EvaluationConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.acting import Acting, Choosing, Optimising
from popl_rl.evaluation.best_of_set import best_of_set, lowest, to_roll
from popl_rl.evaluation.held_out_raters import draw_held_out_raters, favourites, gain
from popl_rl.evaluation.measures import (
    group_accuracy,
    group_returns,
    held_out_pairs,
    new_rater_answers,
)
from popl_rl.evaluation.results import Rows, Scoreboard, Served
from popl_rl.keys import RATER
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.scoring import case_values, segment_scores
from popl_rl.randomness import stream
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import PairPool

__all__ = ["Evaluator"]

_CATERING = {"posterior": "", "lexicase": "_lexicase"}  # what it adds to a method's name
_PANEL = 5  # raters of each of two panels, for each new rater of a group
_PANEL_ANSWERS = 50


class Evaluator:
    """Judges hypotheses by what every hidden group wants; reads what no learner may.

    Args:
        acting: Shows what hypotheses do.
        env: Which infos mean success and doors.
        config: How many answers, raters and pairs.
        groups: G groups.
        bank: Segments to judge on.
        segment_utility: Worth of each segment to each group, ``[G, N]``.
        pool: Pairs to evaluate on; all pairs of the N segments if None.
        clone: A clone of the data's typical behaviour, for comparison; None for none.
        shares: Chance that a rater is of each group; equal if None.
        seed: Seed of the run.
    """

    def __init__(
        self,
        acting: Acting,
        env: EnvConfig,
        config: EvaluationConfig,
        groups: Sequence[RaterGroup],
        bank: SegmentBank,
        segment_utility: Tensor,
        *,
        pool: PairPool | None = None,
        clone: HypothesisSet | None = None,
        shares: Sequence[float] | None = None,
        seed: int,
    ) -> None:
        self.acting, self.env, self.config = acting, env, config
        self.groups, self.bank, self.segment_utility = groups, bank, segment_utility
        self.pool, self.clone = pool, clone
        self.shares, self.seed = shares, seed
        generator = stream(seed, "held-out pairs")
        self.pairs = {
            index: held_out_pairs(
                segment_utility, index, count=config.pairs, pool=pool, generator=generator
            )
            for index in range(len(groups))
        }

    def scores(self, hypotheses: HypothesisSet) -> Tensor:
        """Score of every segment in every hypothesis's eyes, ``[P, N]``."""
        return segment_scores(
            hypotheses.population, self.bank, alpha=hypotheses.alpha, discount=hypotheses.discount
        ).cpu()

    def accuracy(self, hypotheses: HypothesisSet) -> Tensor:
        """Accuracy of every hypothesis on every group's held-out pairs, ``[P, G]``."""
        return group_accuracy(self.scores(hypotheses), self.pairs)

    def snapshot(self, hypotheses: HypothesisSet) -> dict[str, float]:
        """Accuracy of every hypothesis on every group, flat: ``{"<group>/<member>": value}``."""
        columns = self.accuracy(hypotheses).T.tolist()
        return {
            f"{group.name}/{member}": value
            for group, column in zip(self.groups, columns, strict=True)
            for member, value in enumerate(column)
        }

    @cached_property
    def new_raters(self) -> list[list[TensorDict]]:
        """What several new raters of each group answer: the same whatever is being judged.

        Each answers as often as any point of a curve needs; fewer answers are the first of these.
        """
        answers = max([self.config.answers, *self.config.curve])
        said = []
        for index in range(len(self.groups)):
            generator = stream(self.seed, f"new raters/{index}")
            said.append(
                [
                    new_rater_answers(
                        self.groups,
                        index,
                        self.segment_utility,
                        answers=answers,
                        pool=self.pool,
                        generator=generator,
                    )
                    for _ in range(self.config.new_raters)
                ]
            )
        return said

    def cater(
        self, hypotheses: HypothesisSet, method: str, *, answers: int | None = None
    ) -> Tensor:
        """Member given to each of several new raters of each group, ``[G, raters]``.

        Args:
            hypotheses: What is chosen from.
            method: How, see :meth:`~popl_rl.models.hypothesis_set.HypothesisSet.cater`.
            answers: Answers that are known of each; as configured if None.
        """
        known = self.config.answers if answers is None else answers
        picks = []
        for index, raters in enumerate(self.new_raters):
            draw = stream(self.seed, f"lexicase catering/{index}/{known}")
            for said in raters:
                choice = hypotheses.cater(
                    self.bank,
                    said[:known],
                    method=method,  # type: ignore[arg-type]
                    generator=draw,
                )
                picks.append(choice.member)
        return torch.tensor(picks).view(len(self.groups), -1)

    @cached_property
    def held_out(self) -> tuple[TensorDict, TensorDict]:
        """Answers of two panels of new raters in the groups' shares, of unknown groups."""
        generator = stream(self.seed, "panels")
        one, other = (
            draw_held_out_raters(
                self.groups,
                self.segment_utility,
                raters=_PANEL * self.config.new_raters,
                answers=_PANEL_ANSWERS,
                shares=self.shares,
                pool=self.pool,
                generator=generator,
            )
            for _ in range(2)
        )
        return one, other

    def score(
        self,
        hypotheses: HypothesisSet,
        baselines: HypothesisSet | None,
        *,
        reward_baselines: RewardBaselines | None = None,
        label: str = "popl",
    ) -> Scoreboard:
        """Fill the scoreboard.

        Args:
            hypotheses: The set that was found.
            baselines: One trained on everybody's answers, then one oracle per group; None to leave
                them, and with them ``recovery``, out.
            reward_baselines: Other learners of reward functions, for :class:`~popl_rl.evaluation.acting.Choosing` alone.
            label: Name of the method that found ``hypotheses``.
        """
        random = self.acting(None)
        base = None if baselines is None else self.acting(baselines)
        cloned = None if self.clone is None else self.acting(self.clone)
        # What each oracle, in the rows, is worth to each group.
        segment_utility = None if base is None else group_returns(base[1:], self.groups)
        rows = self._rows(random, cloned, segment_utility)
        catered: dict[str, int] = {}
        episodes: dict[tuple[str, str], TensorDict] = {}
        sets = {label: hypotheses} | (
            {} if reward_baselines is None else {"brex": reward_baselines.brex}
        )
        pooled_scores = None if baselines is None else self.scores(baselines)[0]
        for whose, found in sets.items():
            # Curves of what is judged; what it is compared with has too many members for them.
            curve = sorted(set(self.config.curve)) if found is hypotheses else []
            served = self._serve(found, whose, rows, curve=curve)
            self._score_as_a_whole(found, whose, rows, served, pooled_scores)
            if found is hypotheses:
                for index, group in enumerate(self.groups):
                    place = int(served.share(index, served.picks["posterior"]).argmax())
                    catered[group.name] = served.members[place]
                    episodes[label, group.name] = served.rolled[place : place + 1]
        if baselines is not None and base is not None:
            accuracy, one = self.accuracy(baselines), torch.ones(1)
            pooled = "cpl" if isinstance(baselines, PolicySet) else "bradley_terry"
            for index, group in enumerate(self.groups):
                for name, row in ((pooled, 0), ("oracle", 1 + index)):
                    rows.add(name, index, base[row : row + 1], one)
                    value = float(accuracy[row, index])
                    rows.add_accuracy(name, index, value, value)
                    episodes[name, group.name] = base[row : row + 1]
        if reward_baselines is not None:
            self._score_distributional(reward_baselines, rows)
        for index in range(len(self.groups)):
            if cloned is not None:
                rows.add("clone", index, cloned, torch.ones(1))
            rows.add("random", index, random, torch.ones(1))
        rows.add_worst()
        results = pd.DataFrame(rows.rows, columns=["method", "group", "measure", "value"])
        return Scoreboard(results, catered, episodes, label)

    def _rows(
        self, random: TensorDict, cloned: TensorDict | None, segment_utility: Tensor | None
    ) -> Rows:
        """Rows to fill, which know the returns that are a recovery of 0 and of 1."""
        if self.config.reference == "others" and segment_utility is not None:
            alien = segment_utility.masked_fill(
                torch.eye(len(segment_utility), dtype=torch.bool), torch.inf
            )
            floor = alien.amin(0)
        elif self.config.reference == "clone" and cloned is not None:
            floor = group_returns(cloned, self.groups)[0]
        else:
            floor = group_returns(random, self.groups)[0]
        oracle = (
            torch.full_like(floor, torch.nan)
            if segment_utility is None
            else segment_utility.diagonal()
        )
        return Rows(self.groups, self.env, floor=floor, oracle=oracle)

    def _serve(
        self, found: HypothesisSet, label: str, rows: "Rows", *, curve: Sequence[int]
    ) -> "Served":
        """What new raters are given, and what it is worth to them beside the best there is."""
        accuracy = self.accuracy(found)
        picks = {method: self.cater(found, method) for method in _CATERING}
        points = {
            (method, answers): self.cater(found, method, answers=answers)
            for answers in curve
            for method in _CATERING
        }
        fair = torch.tensor(found.fair(self.bank, self.held_out[0]))
        accurate = accuracy.argmax(0)
        always = [*picks.values(), accurate, fair]
        # A member more costs a training of PPO more, where that is how members act.
        limit = 0 if isinstance(self.acting, Optimising) else self.config.curve_members
        members = to_roll(always, points, limit=limit)
        rolled = self.acting(found.subset(members))
        served = Served(picks, members, rolled, int(fair))
        returns = group_returns(rolled, self.groups)
        halves = rolled[:, ::2], rolled[:, 1::2] if rolled.shape[1] > 1 else rolled
        best = best_of_set(*(group_returns(half, self.groups) for half in halves))
        for index in range(len(self.groups)):
            most = float(accuracy[:, index].max())
            for method, chosen in picks.items():
                name = label + _CATERING[method]
                rows.add(name, index, rolled, served.share(index, chosen))
                rows.add_accuracy(name, index, float(accuracy[chosen[index], index].mean()), most)
            rows.add_return(label, index, "best_", float(best[index]))
            place = members.index(int(accurate[index]))
            rows.add_return(label, index, "accurate_", float(returns[place, index]))
            for (method, answers), chosen in points.items():
                name = label + _CATERING[method]
                value = float(accuracy[chosen[index], index].mean())
                rows.add_value(name, index, f"accuracy@{answers}", value)
                if set(chosen.flatten().tolist()) <= set(members):
                    value = float(returns[:, index] @ served.share(index, chosen))
                    value = rows.recovery(index, value)
                    rows.add_value(name, index, f"recovery@{answers}", value)
        return served

    def _score_as_a_whole(
        self,
        found: HypothesisSet,
        label: str,
        rows: "Rows",
        served: "Served",
        pooled: Tensor | None,
    ) -> None:
        """What a set is worth to raters whose group nobody knows: rows of the group ``all``."""
        choosing, measuring = self.held_out
        other = measuring.clone()
        other[RATER] = other[RATER] + _PANEL * self.config.new_raters
        everybody = Comparisons.from_preferences(torch.cat([choosing, other]), cases="rater")
        judging = Comparisons.from_preferences(measuring, cases="rater")
        scores = self.scores(found)
        margin = scores[:, everybody.preferred] - scores[:, everybody.other]
        alone = None if pooled is None else pooled[everybody.preferred] - pooled[everybody.other]
        met = gain(margin, alone, everybody)
        favourite = favourites(margin, everybody)
        fair = scores[served.fair].unsqueeze(0)
        fair = case_values(fair[:, judging.preferred] > fair[:, judging.other], judging)[0]
        place = served.members.index(served.fair)
        returns = group_returns(served.rolled[place : place + 1], self.groups)[0].tolist()
        recoveries = [rows.recovery(index, value) for index, value in enumerate(returns)]
        rows.rows += [
            (label, "all", "distinct", float(len((margin > 0).unique(dim=0)))),
            (label, "all", "effective", found.effective_number(self.bank, everybody)),
            (label, "all", "favourite_share", float(favourite.bincount().max() / len(favourite))),
            (label, "all", "further_accuracy", met.catered),
            (label, "all", "one_for_all_accuracy", met.alone),
            (label, "all", "gain", met.catered - met.alone),
            (label, "all", "gain_error", met.error),
            (label, "all", "fair_worst_rater", float(fair.min())),
            (label, "all", "fair_quantile", float(fair.quantile(0.1))),
            (label, "all", "fair_recovery", lowest(recoveries)),
        ]

    def _score_distributional(self, reward_baselines: RewardBaselines, rows: "Rows") -> None:
        assert isinstance(self.acting, Choosing)
        for label, score in reward_baselines.scores(self.bank).items():
            chosen = self.acting.choose(score.cpu().unsqueeze(0))
            accuracy = group_accuracy(score.cpu().unsqueeze(0), self.pairs)[0].tolist()
            for index, value in enumerate(accuracy):
                rows.add(label, index, chosen, torch.ones(1))
                rows.add_accuracy(label, index, value, value)
        for kind, model in reward_baselines.dpl.items():
            context = model.hidden_context(self.bank)
            rows.rows.append((f"dpl_{kind}", "all", "hidden_context", context))
