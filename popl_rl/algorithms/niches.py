"""POPL for many groups: members find niches, and lexicase selection founds new ones.

Members divide the raters among themselves and descend CPL on those whom they serve, as gradient
lexicase has a child learn where its parent is strong (Ding and Spector, ICLR 2022), but by degrees:
a member serves a rater with the probability that the rater's answers are its own, ``share_k prod
p(answer)``, normalised over the members (the E-step of Dempster, Laird and Rubin, 1977). Left
alone, members settle where they began, and a group that nobody began with is lost. So there is
selection: while the search lasts, members that nobody needs make room for specialists, which are
selected by lexicase over raters.

Members exist in two copies (cross-fitting). Each copy is trained on one half of the raters, and
tells whom members serve in the other half, and whether they are needed there: whether the set
predicts raters better with them whom they have not learnt of. Without this, members would confirm
what they know by heart. When members have settled, those that are needed go on in one copy, which
learns from all answers.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.assembly import find_rule
from popl_rl.algorithms.expectation import expect
from popl_rl.algorithms.losses import descend
from popl_rl.algorithms.needed import nested_subsets, sufficient_size
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.specialists import train_specialists
from popl_rl.algorithms.stacked_adam import StackedAdam
from popl_rl.config import NicheSettings, POPLSettings
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import log_likelihood, per_case
from popl_rl.models.schedules import decay
from popl_rl.models.scoring import case_values, rater_accuracy
from popl_rl.selection.lexicase import lexicase_given_first

__all__ = ["NichePOPL"]

#: Selections for each place to fill: several fall on the same specialist.
_DRAWS = 8


class NichePOPL:
    """One generation after the other: who serves whom, selection, gradient steps.

    Args:
        problem: What is to be learnt; its cases are raters.
        popl: How specialists are trained, and by which rule they are selected.
        niches: When and by how much evidence members come and go.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.
        sizes: Cross-fitted log-likelihood by number of members when they were last counted,
            ``(members, mean, standard error of the gain by the last one)``; empty before.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        popl: POPLSettings,
        niches: NicheSettings,
        generator: torch.Generator,
    ) -> None:
        self.problem, self.settings = problem, niches
        self.select = find_rule(popl.selection, tournament=popl.tournament)
        self.generator = generator
        self.generation = 0
        self.search, self.settled = _schedule(niches, problem.generations)
        self.generations = problem.generations
        self.sizes: list[tuple[int, float, float]] = []
        self.specialists = train_specialists(
            problem, popl, most=niches.specialists, generator=generator
        )
        self.half = _halves(problem, generator)
        self.copies = 2
        founders = self._selected(problem.members)
        self.stack = self.specialists.population.subset(founders * self.copies)
        self.share = torch.full((len(founders),), 1 / len(founders), device=problem.device)
        self.training = StackedAdam(self.stack, problem.training.learning_rate)

    def step(self) -> dict[str, float]:
        """Run one generation.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over raters of the best member's
            accuracy) and ``mean_accuracy``, both as the generation found them, ``members``,
            ``effective_members`` (by their shares of the raters) and ``loss_cpl``.
        """
        problem, comparisons = self.problem, self.problem.comparisons
        now = self.generation
        if now in self.search:
            self._replace_unneeded()
        if now == self.settled:
            self._settle()
        scores = problem.scores(self.stack)
        mine = scores[-len(self.share) :]
        passes = mine[:, comparisons.preferred] > mine[:, comparisons.other]
        likelihood = per_case(self._told(problem.likelihood(scores)), comparisons)
        served = expect(likelihood, self.share).responsibility
        self.share = served.mean(1)
        # A member that serves nobody still needs something: everything, a bit.
        weight = (served[:, comparisons.case] + 1e-9).repeat(self.copies, 1)
        weight = weight * self._trained_on().repeat_interleave(len(self.share), 0)
        rate = problem.training.learning_rate * decay(now, self.generations)
        self.training.optimizer.param_groups[0]["lr"] = rate
        loss = descend(
            problem.loss(self.stack),
            self.training.optimizer,
            comparisons,
            steps=problem.block,
            batch_size=problem.training.batch_size,
            weight=weight,
            generator=self.generator,
        )
        self.generation += 1
        return {
            "worst_rater_accuracy": rater_accuracy(case_values(passes, comparisons)),
            "mean_accuracy": float(passes.float().mean()),
            "members": float(len(self.share)),
            "effective_members": float(1 / self.share.square().sum()),
            "loss_cpl": loss,
        }

    @property
    def population(self) -> Population:
        """The members as they are now, in their last copy."""
        count = len(self.share)
        return self.stack.subset(range((self.copies - 1) * count, self.copies * count))

    def result(self) -> HypothesisSet:
        """The members that are left, their scale fitted for catering."""
        found = self.problem.hypothesis_set(self.population)
        found.origin = []  # the population has been cut down to them
        return self.problem.calibrated(found)

    def _selected(self, count: int, value: Tensor | None = None) -> list[int]:
        """Up to ``count`` different specialists, selected by what they are to the raters.

        Args:
            count: Places to fill.
            value: How well each rater is predicted so far, ``[C]``; if given, the first cases of
                every other selection are raters out of the third who are predicted worst.
        """
        values, generator = self.specialists.values, self.generator
        draws = _DRAWS * count
        if self.select is not None:
            chosen = self.select(values, draws, generator=generator)
            return list(dict.fromkeys(chosen.tolist()))[:count]
        raters = values.shape[1]
        first = torch.randint(raters, (draws,), generator=generator, device=values.device)
        if value is not None:
            worst = value.argsort()[: -(-raters // 3)]
            first[::2] = worst[first[::2] % len(worst)]
        chosen = lexicase_given_first(values, first, generator=generator).parents
        return list(dict.fromkeys(chosen.tolist()))[:count]

    def _replace_unneeded(self) -> None:
        """Fill the places of members that nobody needs by selected specialists."""
        nested = nested_subsets(self._likelihood(), self.problem.comparisons)
        needed = int(nested.value.mean(1).argmax()) + 1
        born = self._selected(max(1, self.problem.members - needed), nested.value[needed - 1])
        self._become(nested.order[:needed], born)

    def _settle(self) -> None:
        """Keep the members that are needed, in one copy that learns of all raters from now on."""
        nested = nested_subsets(self._likelihood(), self.problem.comparisons)
        needed = sufficient_size(nested, evidence=self.settings.evidence)
        if needed >= self.problem.members:
            warnings.warn(
                f"all {needed} members are needed, so there may be more groups than members; raise "
                "method.members",
                stacklevel=2,
            )
        self._become(nested.order[:needed], [])
        stack = self.stack.subset(range(needed))
        self.training = self.training.moved_to(stack, range(needed))
        self.stack, self.copies = stack, 1
        errors = [0.0, *(error for _, error in nested.gains())]
        rows = zip(nested.value.mean(1).tolist(), errors, strict=True)
        self.sizes = [(size, *row) for size, row in enumerate(rows, start=1)]

    def _likelihood(self) -> Tensor:
        """Log-likelihood of every answer under every member, ``[K, M]``, as catering reckons it.

        Without the conservatism of training, under which the chances of an answer and of its
        opposite do not sum to 1: that would count members that find all segments of a rater likely.
        """
        margin = self.problem.margins(self.stack)
        return self._told(log_likelihood(margin, self.problem.training.slip))

    def _told(self, likelihood: Tensor) -> Tensor:
        """Of all copies ``[copies * K, M]``, what the one says that has not learnt of the rater."""
        if self.copies == 1:
            return likelihood
        first, second = likelihood.chunk(2)
        return torch.where(self.half[self.problem.comparisons.case] == 0, first, second)

    def _trained_on(self) -> Tensor:
        """Comparisons that each copy learns from, ``[copies, M]``: of one half, or all."""
        half = self.half[self.problem.comparisons.case]
        if self.copies == 1:
            return torch.ones_like(half).unsqueeze(0)
        return torch.stack([half, 1 - half])

    def _become(self, kept: Sequence[int], born: Sequence[int]) -> None:
        """Go on with some of the members, and with some specialists beside them, in every copy."""
        kept, born = sorted(kept), list(born)
        fresh = self.share.new_full((len(born),), 1 / (len(kept) + len(born)))
        share = torch.cat([self.share[kept], fresh])
        old = torch.arange(len(self.stack)).view(self.copies, -1)[:, kept]
        new = len(self.stack) + torch.tensor(born, dtype=torch.long).expand(self.copies, -1)
        # Rows of the present members, with the specialists behind them.
        source = torch.cat([old, new], 1).flatten()
        both = torch.cat([self.stack.members.data, self.specialists.population.members.data])
        self.share = share / share.sum()
        stack = self.stack.with_members(both[source].clone())
        self.training = self.training.moved_to(stack, source)
        self.stack = stack

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "copies": self.copies,
            "count": len(self.stack),
            "members": self.stack.members.data.clone().to_dict(),
            "share": self.share.clone(),
            "sizes": [list(row) for row in self.sizes],
            "training": self.training.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.generation = int(state["generation"])
        self.copies, count = int(state["copies"]), int(state["count"])
        if count != len(self.stack):
            self.stack = self.specialists.population.subset([0] * count)
            self.training = StackedAdam(self.stack, self.problem.training.learning_rate)
        self.stack.members.data.update_(state["members"])
        self.share = state["share"].clone()
        self.sizes = [(int(row[0]), float(row[1]), float(row[2])) for row in state["sizes"]]
        self.training.load_state_dict(state["training"])
        self.generator.set_state(state["generator"].cpu())


def _halves(problem: Problem, generator: torch.Generator) -> Tensor:
    """A random half, 0 or 1, for each rater, ``[C]``."""
    raters = problem.comparisons.num_cases
    if raters < 2:
        raise ValueError(
            "POPL with rater ids needs at least 2 raters, got 1; with one rater there are no "
            "groups to find: take method=cpl"
        )
    return torch.randperm(raters, generator=generator, device=problem.device) % 2


def _schedule(settings: NicheSettings, generations: int) -> tuple[set[int], int]:
    """Generations before which specialists come in, and the one by which members have settled."""
    settled = max(1, round(settings.settled * generations))
    times = range(1, settings.selections + 1)
    # In the first fifth, so that members that come in have time to show what they are for.
    return {max(1, settled * time // (5 * settings.selections)) for time in times}, settled
