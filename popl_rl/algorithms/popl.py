"""Pareto-optimal preference learning: score, select by lexicase, vary.

POPL (Bahlous-Boldi, Ding, Spector, Niekum, arXiv 2406.15599) with policies that rank segments as
CPL policies do. Nothing here reads or writes a file, and nothing knows who the raters are.
"""

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.rater_similarity import RaterSimilarity
from popl_rl.algorithms.refinement import refine
from popl_rl.algorithms.variation import Variation
from popl_rl.config import RefinementSettings
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.scoring import rater_accuracy
from popl_rl.selection.lexicase import SelectionReport, lexicase_given_first, lexicase_report
from popl_rl.selection.mad import mad
from popl_rl.selection.rules import Selection, report

#: What a child learns from similar raters on whom its parent is weak, against 1 where it is strong.
#: Without it a first child for a small group learns from the one or two raters that its parent
#: happens to pass; much more of it blurs groups that are each other's nearest.
_FLOOR = 0.2

__all__ = ["POPL"]


class POPL:
    """One generation after the other: score, select, vary; at the end, refine.

    Args:
        problem: What is to be learnt.
        population: N members, changed in place.
        variation: How children differ from their parents.
        epsilon: Tolerance of lexicase selection; ``"mad"``, a number, or None for none.
        similarity: How alike the C raters want. If given, a child is selected for one rater,
            whose case comes first in its order, and learns from raters like that one. Half of these
            raters are random, the others unlike each other, so that small groups are not
            overlooked.
        select: Rule that takes the place of lexicase selection; for whom children are, and what
            they learn, stays as it is.
        refinement: How what has been found is to be trained when all generations are done; None to
            keep every distinct member as it is.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.
        progress: Called with the number of steps that the last training has done; None for nobody.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        population: Population,
        variation: Variation,
        epsilon: float | Literal["mad"] | None = "mad",
        similarity: RaterSimilarity | None = None,
        select: Selection | None = None,
        refinement: RefinementSettings | None = None,
        generator: torch.Generator,
    ) -> None:
        self.problem = problem
        self.population = population
        self.variation = variation
        self.epsilon = epsilon
        self.similarity = similarity
        self.select = select
        self.refinement = refinement
        self.generator = generator
        self.generation = 0
        self.generations = problem.generations
        self.progress: Callable[[int], None] | None = None

    def step(self) -> dict[str, float]:
        """Run one generation.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over cases of the best
            member's accuracy), ``mean_accuracy``, ``selection_depth`` (cases used per selection),
            ``distinct`` and ``effective_parents``, and what the variation reports.
        """
        values, mean = self.problem.pass_shares(self.population)
        tolerance = mad(values) if self.epsilon == "mad" else self.epsilon
        strong = values >= values.amax(0) - (0.0 if tolerance is None else tolerance)
        first = None if self.similarity is None else self._first_raters(self.similarity)
        selected = self._select(values, first, tolerance)
        strength = strong.float()[selected.parents]
        if self.similarity is not None and first is not None:
            strength = (strength + _FLOOR) * self.similarity.rows(first).clamp(min=0)
        varied = self.variation(selected.parents, strength)
        self.generation += 1
        return {
            "worst_rater_accuracy": rater_accuracy(values),
            "mean_accuracy": mean,
            "selection_depth": float(selected.depth.float().mean()),
            "distinct": float(selected.distinct),
            "effective_parents": selected.effective,
            **varied,
        }

    def _select(
        self, values: Tensor, first: Tensor | None, tolerance: float | Tensor | None
    ) -> SelectionReport:
        count, generator = len(self.population), self.generator
        if self.select is not None:
            return report(values, self.select(values, count, generator=generator))
        if first is None:
            return lexicase_report(values, count, epsilon=tolerance, generator=generator)
        return lexicase_given_first(values, first, epsilon=tolerance, generator=generator)

    def _first_raters(self, similarity: RaterSimilarity) -> Tensor:
        """For whom the children are: half at random, half unlike each other, ``[N]``."""
        spread = len(self.population) // 2
        shape = (len(self.population) - spread,)
        device = self.generator.device
        first = torch.randint(len(similarity), shape, generator=self.generator, device=device)
        return torch.cat([first, similarity.spread_out(spread, generator=self.generator)])

    def result(self) -> HypothesisSet:
        """The refined members, or one member for each behaviour, scaled for catering."""
        if self.refinement is None:
            return self.problem.calibrated(self.problem.distinct(self.population))
        refined = refine(
            self.problem,
            self.population,
            settings=self.refinement,
            generator=self.generator,
            progress=self.progress,
        )
        found = self.problem.hypothesis_set(refined)
        found.origin = []  # trained on, they are no longer members of the population
        return self.problem.calibrated(found)

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "members": self.population.members.data.clone().to_dict(),
            "variation": self.variation.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.generation = int(state["generation"])
        self.population.members.data.update_(state["members"])
        self.variation.load_state_dict(state["variation"])
        self.generator.set_state(state["generator"].cpu())
