"""The scoreboard of a run: every method, every group, every measure, in tidy rows.

Rows are ``method, choice, group, measure, value``. The choice is how a member was chosen from a
set: ``posterior`` or ``lexicase`` catering; ``information_gain``, posterior catering to answers to
questions that were chosen instead of drawn (curves alone); ``expectation`` or ``risk_averse``; it
is empty where there is one hypothesis only, and for measures of a set as a whole.

For each group and choice: ``return, return_error, reward, length, recovery, success, accuracy,
best_accuracy`` of what new raters are given after ``evaluation.answers`` answers: what episodes are
worth to the group and the standard error of that, the environment's own reward of an episode, and
its steps; ``accuracy@K`` and ``recovery@K`` after K answers.
Of a set as a whole, ``best_return`` and ``best_recovery`` of the best of the members rolled out,
without the luck of the best, and ``accurate_return`` and ``accurate_recovery`` of the member that
ranks the group's held-out pairs best. Where the environment has a transition table, each of these
recoveries has a ``share_of_optimum`` beside it, from exact returns instead of rollouts (and one of
always taking the most likely action, ``greedy_share_of_optimum``); so has choice from menus.

For the group ``all``: ``worst_recovery, worst_share_of_optimum`` and ``coverage`` of the groups,
and ``rater_quantile_share_of_optimum`` and ``rater_quantile_accuracy``, the 10 % quantiles over
raters in the groups' shares.
For a set also the number of ``distinct`` and ``effective`` members; how well it meets held-out
raters whose groups nobody looks at, see ``popl_rl.evaluation.held_out_raters`` and
``popl_rl.evaluation.unexplained_raters``; and of the fair choice of one panel of held-out raters,
its accuracy for the worst rater of another panel (``fair_worst_rater``) and the 10 % quantile
(``fair_quantile``), and its recovery for the group that it serves worst (``fair_recovery``).
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.algorithms.reward_baselines import RewardBaselines
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.acting import Acting, Optimising, Rolling
from popl_rl.evaluation.best_of_set import lowest, to_roll
from popl_rl.evaluation.catering_curves import score_curves
from popl_rl.evaluation.chosen_questions import ask_new_raters
from popl_rl.evaluation.held_out_raters import draw_held_out_raters, favourites, gain
from popl_rl.evaluation.hindsight import score_hindsight
from popl_rl.evaluation.left_data import score_region
from popl_rl.evaluation.measures import (
    group_accuracy,
    group_returns,
    held_out_pairs,
    new_rater_answers,
)
from popl_rl.evaluation.optimum import ExactReturns, known_scale, menu_returns
from popl_rl.evaluation.protocol import EvaluationProtocol, MeasuredInfos
from popl_rl.evaluation.references import (
    score_baselines,
    score_distributional,
    score_references,
)
from popl_rl.evaluation.results import Performance, Rows, Scoreboard, Served
from popl_rl.evaluation.unexplained_raters import look_for_unexplained
from popl_rl.keys import RATER
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.scoring import case_values, segment_scores
from popl_rl.randomness import stream
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import PairPool

__all__ = ["Evaluator"]

_CATERING = ("posterior", "lexicase")  # kinds of catering, the headline first
_PANEL = 5  # raters of each of two panels, for each new rater of a group
_PANEL_ANSWERS = 50


class Evaluator:
    """Evaluates hypotheses by what every hidden group wants; reads what no learner may.

    Args:
        acting: Shows what hypotheses do.
        groups: G groups.
        bank: N segments to evaluate on.
        segment_utility: Utility of each segment to each group, ``[G, N]``.
        protocol: How many answers, raters and pairs.
        infos: Which infos mean success and doors.
        pool: Pairs to evaluate on; all pairs of the N segments if None.
        clone: A clone of the data's typical behaviour, for comparison; None for none.
        shares: Chance that a rater is of each group; equal if None.
        seed: Seed of the run.
    """

    def __init__(
        self,
        acting: Acting,
        groups: Sequence[RaterGroup],
        bank: SegmentBank,
        segment_utility: Tensor,
        *,
        protocol: EvaluationProtocol,
        infos: MeasuredInfos,
        pool: PairPool | None = None,
        clone: HypothesisSet | None = None,
        shares: Sequence[float] | None = None,
        seed: int,
    ) -> None:
        self.acting, self.protocol, self.infos = acting, protocol, infos
        self.groups, self.bank, self.segment_utility = groups, bank, segment_utility
        self.pool, self.clone = pool, clone
        self.shares, self.seed = shares, seed
        generator = stream(seed, "held-out pairs")
        self.pairs = {
            index: held_out_pairs(
                segment_utility, index, count=protocol.pairs, pool=pool, generator=generator
            )
            for index in range(len(groups))
        }
        self._exact = known_scale(acting, groups)
        self._policies = acting.policies if isinstance(acting, Rolling) else None

    def scores(self, hypotheses: HypothesisSet) -> Tensor:
        """Scores of all segments, ``[P, N]``; those that nobody is asked about may be NaN."""
        how: dict[str, Any] = {"alpha": hypotheses.alpha, "discount": hypotheses.discount}
        if self.pool is not None and self.pool.allowed is not None:
            how["wanted"] = self.pool.allowed
        return segment_scores(hypotheses.population, self.bank, **how).cpu()

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
        """What new raters of each group answer, whoever is judged; fewer are the first of these."""
        answers = max([self.protocol.answers, *self.protocol.curve])
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
                    for _ in range(self.protocol.new_raters)
                ]
            )
        return said

    def cater(
        self,
        hypotheses: HypothesisSet,
        method: str,
        *,
        answers: int | None = None,
        scores: Tensor | None = None,
    ) -> Tensor:
        """Member given to each of several new raters of each group, ``[G, raters]``.

        Args:
            hypotheses: What is chosen from.
            method: How, see ``popl_rl.models.hypothesis_set.HypothesisSet.cater``.
            answers: Answers that are known of each; as configured if None.
            scores: As of ``scores``, where they are known.
        """
        picks, known = [], self.protocol.answers if answers is None else answers
        for index, raters in enumerate(self.new_raters):
            generator = stream(self.seed, f"lexicase catering/{index}/{known}")
            how: Any = {"method": method, "scores": scores, "generator": generator}
            picks += [hypotheses.cater(self.bank, said[:known], **how).member for said in raters]
        return torch.tensor(picks).view(len(self.groups), -1)

    @cached_property
    def held_out(self) -> tuple[TensorDict, TensorDict]:
        """Answers of two panels of new raters in the groups' shares, of unknown groups."""
        generator = stream(self.seed, "panels")
        one, other = (
            draw_held_out_raters(
                self.groups,
                self.segment_utility,
                raters=_PANEL * self.protocol.new_raters,
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
        ppo: PolicySet | None = None,
        label: str = "popl",
    ) -> Scoreboard:
        """Fill the scoreboard.

        Args:
            hypotheses: The set that was found.
            baselines: One trained on everybody's answers, then one oracle per group; None to leave
                them, and with them ``recovery``, out.
            reward_baselines: Other learners of reward functions, for
                ``popl_rl.evaluation.acting.Choosing`` alone.
            ppo: A policy for each group, trained on its utility, to compare with.
            label: Name of the method that found ``hypotheses``.
        """
        random = self._perform(None)
        base = None if baselines is None else self._perform(baselines)
        cloned = None if self.clone is None else self._perform(self.clone)
        rows = self._rows(random, cloned, base)
        pooled_scores = None if baselines is None else self.scores(baselines)[0]
        # Curves of what is evaluated; what it is compared with has too many members for them.
        curve = sorted(set(self.protocol.curve))
        served = self._serve(hypotheses, label, rows, curve=curve)
        self._score_as_a_whole(hypotheses, label, rows, served, pooled_scores)
        catered: dict[str, int] = {}
        episodes: dict[tuple[str, str], TensorDict] = {}
        for index, group in enumerate(self.groups):
            place = int(served.share(index, served.picks["posterior"]).argmax())
            catered[group.name] = served.members[place]
            episodes[label, group.name] = served.performance.one(place).episodes
        if isinstance(hypotheses, PolicySet):
            score_region(rows, label, self.bank, list(episodes.values()), seed=self.seed)
        if reward_baselines is not None:
            brex = self._serve(reward_baselines.brex, "brex", rows, curve=[])
            self._score_as_a_whole(reward_baselines.brex, "brex", rows, brex, pooled_scores)
        if baselines is not None and base is not None:
            pooled = "pooled_cpl" if isinstance(baselines, PolicySet) else "bradley_terry"
            episodes |= score_baselines(rows, base, self.accuracy(baselines), pooled=pooled)
        if reward_baselines is not None:
            score_distributional(rows, reward_baselines, self.acting, self.bank, self.pairs)
        for index in range(len(self.groups)):
            if cloned is not None:
                rows.add(("clone", ""), index, cloned, torch.ones(1))
            rows.add(("random", ""), index, random, torch.ones(1))
        best = None if ppo is None else self._perform(ppo)
        score_references(rows, self.acting, ppo=best, exact=self._exact)
        rows.add_worst()
        return Scoreboard(rows.table(), catered, episodes, label, served)

    def _perform(self, hypotheses: HypothesisSet | None) -> Performance:
        """Episodes of every hypothesis, and exact returns where the optimum is known."""
        episodes = self.acting(hypotheses)
        if isinstance(self._exact, ExactReturns) and self._policies is not None:
            policies = self._policies(hypotheses)
            return Performance(episodes, self._exact(policies), self._exact.of_greedy(policies))
        known = self._exact is not None  # of choosing from menus, all of which are in the episodes
        own = menu_returns(episodes, self.groups) if known else None
        return Performance(episodes, own)

    def _rows(
        self, random: Performance, cloned: Performance | None, base: Performance | None
    ) -> Rows:
        """Rows to fill, which know the returns that are a recovery of 0 and of 1."""
        # Return of each oracle, in the rows, to each group.
        returns = None if base is None else group_returns(base.episodes[1:], self.groups)
        if self.protocol.reference == "others" and returns is not None:
            own = torch.eye(len(returns), dtype=torch.bool)
            floor = returns.masked_fill(own, torch.inf).amin(0)
        elif self.protocol.reference == "clone" and cloned is not None:
            floor = group_returns(cloned.episodes, self.groups)[0]
        else:
            floor = group_returns(random.episodes, self.groups)[0]
        oracle = torch.full_like(floor, torch.nan) if returns is None else returns.diagonal()
        return Rows(
            self.groups,
            self.infos,
            floor=floor,
            oracle=oracle,
            exact=self._exact,
            shares=self.shares,
        )

    def _serve(
        self, found: HypothesisSet, label: str, rows: Rows, *, curve: Sequence[int]
    ) -> Served:
        """What new raters are given, and what it is worth to them beside the best there is."""
        scores = self.scores(found)
        accuracy = group_accuracy(scores, self.pairs)
        picks = {method: self.cater(found, method, scores=scores) for method in _CATERING}
        points = {
            (method, answers): self.cater(found, method, answers=answers, scores=scores)
            for answers in curve
            for method in _CATERING
        }
        fair = torch.tensor(found.fair(self.bank, self.held_out[0]))
        accurate = accuracy.argmax(0)
        always = [*picks.values(), accurate, fair]
        # A member more costs a training of PPO more, where that is how members act.
        limit = 0 if isinstance(self.acting, Optimising) else self.protocol.curve_members
        members = to_roll(always, points, limit=limit)
        done = self._perform(found.subset(members))
        served = Served(picks, members, done, int(fair))
        for index in range(len(self.groups)):
            most = float(accuracy[:, index].max())
            for method, chosen in picks.items():
                share, given = served.share(index, chosen), accuracy[chosen[index], index]
                rows.add((label, method), index, done, share, raters=chosen.shape[1])
                rows.add_accuracy((label, method), index, catered=given, best=most)
        score_hindsight(rows, label, done, [members.index(int(one)) for one in accurate])
        score_curves(rows, label, served, points, accuracy)
        if curve:
            self._score_chosen(found, label, rows, served, scores, curve=curve, limit=limit)
        return served

    def _score_chosen(
        self,
        found: HypothesisSet,
        label: str,
        rows: Rows,
        served: Served,
        scores: Tensor,
        *,
        curve: Sequence[int],
        limit: int,
    ) -> None:
        """The same curves after questions that were chosen for each new rater."""
        points = ask_new_raters(
            found,
            self.groups,
            self.bank,
            scores,
            self.segment_utility,
            raters=self.protocol.new_raters,
            curve=curve,
            pool=self.pool,
            seed=self.seed,
        )
        wanted = to_roll([], points, limit=limit)
        if not set(wanted) <= set(served.members):
            done = self._perform(found.subset(wanted))
            served = Served(served.picks, wanted, done, served.fair)
        score_curves(rows, label, served, points, group_accuracy(scores, self.pairs))

    def _score_as_a_whole(
        self,
        found: HypothesisSet,
        label: str,
        rows: Rows,
        served: Served,
        pooled: Tensor | None,
    ) -> None:
        """What a set is worth to raters whose group nobody knows: rows of the group ``all``."""
        choosing, measuring = self.held_out
        other = measuring.clone()
        other[RATER] = other[RATER] + _PANEL * self.protocol.new_raters
        everybody = Comparisons.from_preferences(torch.cat([choosing, other]), cases="rater")
        judging = Comparisons.from_preferences(measuring, cases="rater")
        scores = self.scores(found)
        margin = scores[:, everybody.preferred] - scores[:, everybody.other]
        alone = None if pooled is None else pooled[everybody.preferred] - pooled[everybody.other]
        met = gain(margin, alone, everybody)
        favourite = favourites(margin, everybody)
        fair = scores[served.fair].unsqueeze(0)
        fair = case_values(fair[:, judging.preferred] > fair[:, judging.other], judging)[0]
        chosen = served.performance.one(served.members.index(served.fair))
        returns = group_returns(chosen.episodes, self.groups)[0].tolist()
        values = {
            "distinct": float(len((margin > 0).unique(dim=0))),
            "effective": found.effective_number(self.bank, everybody),
            "favourite_share": float(favourite.bincount().max() / len(favourite)),
            "further_accuracy": met.catered,
            "one_for_all_accuracy": met.alone,
            "gain": met.catered - met.alone,
            "gain_error": met.error,
            "fair_worst_rater": float(fair.min()),
            "fair_quantile": float(fair.quantile(0.1)),
            "fair_recovery": lowest([rows.recovery(i, value) for i, value in enumerate(returns)]),
        }
        if self._exact is not None and chosen.exact is not None:
            exact = chosen.exact[0].tolist()
            shares = [self._exact.share_of_optimum(i, value) for i, value in enumerate(exact)]
            values["fair_share_of_optimum"] = lowest(shares)
        lost = look_for_unexplained(
            scores,
            self.groups,
            self.segment_utility,
            new_raters=self.protocol.new_raters,
            shares=self.shares,
            pool=self.pool,
            seed=self.seed,
        )
        for measure, value in (values | lost.measures()).items():
            rows.add_whole((label, ""), measure, value)
