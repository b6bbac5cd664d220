"""POPL for any number of groups: search for niches, count them by held-out raters, train anew.

Several searches (see ``popl_rl.algorithms.niche_search``) run side by side, and each rater is held
out of one. In the first part of a search, members divide the raters among themselves, and lexicase
selects the parents of new members. In the second, populations of several sizes train on. What most
searches agree upon (see ``popl_rl.algorithms.agreement``) is judged by the raters who were held
out, as it was found and, for the numbers that look best, by fresh members (see
``popl_rl.algorithms.trials``): the number of niches is taken that predicts people whom nobody has
learnt of best. A number that was tried counts by the better of its two values, which favours it a
little. Before one niche is taken for everybody, it is divided in two (see
``popl_rl.algorithms.divided_in_two``). At last, fresh members are trained by the whole recipe on
the division of the raters that was found: what was learnt while it was wrong would stay otherwise.
"""

import warnings
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.agreement import Agreement, agreements
from popl_rl.algorithms.divided_in_two import divided_in_two
from popl_rl.algorithms.needed import behind_best, standard_error, sufficient
from popl_rl.algorithms.niche_members import GIVEN, NicheMembers
from popl_rl.algorithms.niche_search import NicheSearch
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.trials import Fold, Trial, trials
from popl_rl.config import NicheSettings, POPLSettings
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.scoring import rater_accuracy

__all__ = ["NichePOPL"]

_SEARCH = 0.44  # of the generations before settling, after which sizes are compared
# What two niches must predict better by where searches found one: standard errors (5 %, one-sided),
# and nats of an answer.
_SURE, _WORTH = 1.645, 0.002


class NichePOPL:
    """One generation after the other: searches side by side, then one population.

    Args:
        problem: What is to be learnt; its cases are raters.
        popl: How specialists are trained, and by which rule parents are selected.
        niches: How many searches, and when they come to an end.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished: of the searches, and the problem's.
        sizes: What was compared, ``(niches, mean log-likelihood of held-out raters' answers,
            standard error of how far that is behind the best, paired over raters)``; empty before.
        scale: How much the members' scores are to be believed when they are catered, by raters whom
            a search had not learnt of; 1 before.

    Raises:
        ValueError: If there is a single rater.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        popl: POPLSettings,
        niches: NicheSettings,
        generator: torch.Generator,
    ) -> None:
        raters = problem.comparisons.num_cases
        if raters < 2:
            raise ValueError(
                "POPL with rater ids needs at least 2 raters, got 1; with one rater there are no "
                "groups to find: take method=cpl"
            )
        self.problem, self.settings, self.generator = problem, niches, generator
        self.generation = 0
        self.settled = max(1, round(niches.settled * problem.generations))
        # Fresh members get as many steps as those of every other method.
        self.generations = self.settled + problem.generations
        self.divided = round(_SEARCH * self.settled)
        times = range(1, niches.selections + 1)
        self.selections = {self.divided * time // (niches.selections + 1) for time in times}
        self.sizes: list[tuple[int, float, float]] = []
        self.scale = 1.0
        count = min(niches.searches, raters)
        order = torch.randperm(raters, generator=generator, device=problem.device)
        self.held_out = order % count
        self.searches = [
            NicheSearch(
                problem,
                held_out=self.held_out == index,
                popl=popl,
                niches=niches,
                generator=generator,
            )
            for index in range(count)
        ]
        self.found: NicheMembers | None = None

    def step(self) -> dict[str, float]:
        """Run one generation.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over raters of the best member's
            accuracy) and ``mean_accuracy``, as the generation found them and in the first of
            several searches, ``members`` in all searches together, ``effective_members`` (by their
            shares of the raters) and ``loss_cpl``.
        """
        if self.generation == self.settled:
            self._settle()
        passed = self.problem.pass_shares(self.population)
        if self.found is None:
            members = sum(len(search.stack) for search in self.searches)
            loss = self._search()
        else:
            members = len(self.found.share)
            loss = self._train(self.found)
        share = self.searches[0].share_of_largest() if self.found is None else self.found.share
        self.generation += 1
        return {
            "worst_rater_accuracy": rater_accuracy(passed.values),
            "mean_accuracy": passed.mean,
            "members": float(members),
            "effective_members": float(1 / share.square().sum()),
            "loss_cpl": loss,
        }

    @property
    def population(self) -> Population:
        """The members as they are now; before settling those of the first search's largest size."""
        return self.searches[0].largest() if self.found is None else self.found.stack

    def result(self) -> HypothesisSet:
        """The members that serve somebody, with scores of the scale that held-out raters gave."""
        population = self.population
        if self.found is not None:
            raters = self.found.share * self.problem.comparisons.num_cases
            alive = (raters >= 0.5) | (raters == raters.max())
            population = population.subset(alive.nonzero()[:, 0].tolist())
        found = self.problem.hypothesis_set(population)
        found.origin = []  # the population has been cut down to them
        found.alpha *= self.scale
        return found

    def _search(self) -> float:
        losses = []
        for search in self.searches:
            if self.generation == self.divided:
                search.divide()
            elif self.generation in self.selections and self.generation:
                search.replace_unneeded()
            losses.append(search.step())
        return sum(losses) / len(losses)

    def _train(self, found: NicheMembers) -> float:
        now, last = self.generation - self.settled, self.generations - self.settled
        return found.step(now, last, given=GIVEN)

    def _settle(self) -> None:
        """Choose the number of niches by raters held out, and start anew from who is in which."""
        for search in self.searches:
            if not search.sizes:
                search.divide()
        divided = [search.divisions() for search in self.searches]
        judged = [search.judged for search in self.searches]
        agreed = agreements(self.problem, judged, divided)
        tried = self._try_out(agreed)
        values = [one.value for one in agreed]
        for index, trial in tried.items():
            values[index] = max(values[index], trial.value, key=torch.mean)
        behind = behind_best(torch.stack(values))
        chosen = sufficient(behind, evidence=self.settings.evidence)
        best = agreed[chosen]
        mean = [float(value.mean()) for value in values]
        error = standard_error(behind).tolist()
        number = [one.number for one in agreed]
        self.sizes = list(zip(number, mean, error, strict=True))
        self.scale = tried[chosen].scale if chosen in tried else best.scale(judged)
        if best.number == 1:
            best = self._unless_two(best, values[chosen])
        # Where some members serve nobody, there was room for more.
        most = min(map(len, divided))
        if best.found == most == min(search.sizes[-1] for search in self.searches):
            warnings.warn(
                f"the largest number of members compared, {most}, predicts raters best, so "
                "there may be more groups than members; raise method.members",
                stacklevel=2,
            )
        self.found = NicheMembers(self.problem, best.served(self.problem), generator=self.generator)

    def _unless_two(self, one: Agreement, value: Tensor) -> Agreement:
        """One niche for everybody, unless a division in two predicts raters surely better."""
        folds, generations = self._folds(), self._trial_generations()
        two = divided_in_two(
            self.problem, folds, value, generations=generations, generator=self.generator
        )
        if two is None:
            return one
        both = torch.stack([value, two.value])
        behind = behind_best(both)
        if sufficient(behind, evidence=_SURE, negligible=_WORTH) == 0:
            return one
        mean, error = both.mean(1).tolist(), standard_error(behind).tolist()
        self.sizes = list(zip((1, 2), mean, error, strict=True))
        self.scale = two.scale([fold.judged for fold in folds])
        return two

    def _try_out(self, agreed: list[Agreement]) -> dict[int, Trial]:
        """Trials of the numbers that look best, with the steps of ``niches.trial_steps``."""
        generations = self._trial_generations()
        folds, generator = self._folds(), self.generator
        return trials(self.problem, folds, agreed, generations=generations, generator=generator)

    def _folds(self) -> list[Fold]:
        return [Fold(search.problem, search.judged) for search in self.searches]

    def _trial_generations(self) -> int:
        generations = -(-self.settings.trial_steps // self.problem.block)
        return min(generations, self.problem.generations)

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "searches": [] if self.found else [one.state_dict() for one in self.searches],
            "found": None if self.found is None else self.found.state_dict(),
            "sizes": [list(row) for row in self.sizes],
            "scale": self.scale,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.generation = int(state["generation"])
        self.sizes = [(int(row[0]), float(row[1]), float(row[2])) for row in state["sizes"]]
        self.scale = float(state["scale"])
        if state["found"] is None:
            for search, own in zip(self.searches, state["searches"], strict=True):
                search.load_state_dict(own)
        else:
            served = state["found"]["served"]
            self.found = NicheMembers(self.problem, served, generator=self.generator)
            self.found.load_state_dict(state["found"])
        self.generator.set_state(state["generator"].cpu())
