"""One search for niches: members divide raters among themselves, selection founds new members.

A search never learns of some raters, who judge how many members there should be. All the others
are divided among the members by degrees: a member serves a rater with the probability that the
rater's answers are its own, ``share_k prod p(answer)``, normalised over the members (the E-step of
Dempster, Laird and Rubin, 1977), and descends CPL on those whom it serves. Left alone, members
settle where they began, and a group that nobody began with is lost. So, now and then, members that
nobody needs make room for children: copies of parents that lexicase selects for one rater, which
learn for a moment what that rater said (gradient lexicase, Ding and Spector, ICLR 2022).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.assembly import find_rule
from popl_rl.algorithms.divisions import Division, divisions
from popl_rl.algorithms.draws import by_case
from popl_rl.algorithms.expectation import expect
from popl_rl.algorithms.losses import descend
from popl_rl.algorithms.needed import nested_subsets, predicted, sizes_up_to
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.specialists import personalise, train_specialists
from popl_rl.algorithms.stacked_adam import StackedAdam
from popl_rl.config import NicheSettings, POPLSettings, parse_epsilon
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import answer_likelihood, per_case
from popl_rl.models.scoring import case_values
from popl_rl.selection.lexicase import lexicase_given_first
from popl_rl.selection.mad import mad

__all__ = ["NicheSearch"]

#: Selections for each founder: several fall on the same specialist.
_DRAWS = 8
_KEPT = 0.75  # of the members, at most, when others are to make room
_CHILD_RATE = 0.5  # of the recipe's learning rate, at which a child learns from its rater

#: Answers per step of a child's moment with its rater.
_CHILD_BATCH = 32


class NicheSearch:
    """A population that divides raters among its members; later several, of several sizes.

    Args:
        problem: What is to be learnt.
        held_out: Raters that it must not learn of, ``[C]`` bool.
        popl: How specialists are trained, and how parents are selected.
        niches: How many specialists, and when members come and go.
        generator: Source of all randomness.

    Attributes:
        share: Share of the raters that each member serves, ``[K]``; of each size summing to 1.
        sizes: Sizes of the populations side by side; empty while there is one.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        held_out: Tensor,
        popl: POPLSettings,
        niches: NicheSettings,
        generator: torch.Generator,
    ) -> None:
        comparisons = problem.comparisons
        aside = held_out[comparisons.case]
        self.problem = replace(problem, comparisons=comparisons.rows((~aside).nonzero()[:, 0]))
        self.judged = replace(problem, comparisons=comparisons.rows(aside.nonzero()[:, 0]))
        self.raters = (~held_out).nonzero()[:, 0]
        self.popl, self.generator = popl, generator
        self.rule = find_rule(popl.selection, tournament=popl.tournament)
        found = train_specialists(self.problem, popl, most=niches.specialists, generator=generator)
        values = found.values[:, self.raters]
        first = self._draw_raters(_DRAWS * problem.members)
        founders = list(dict.fromkeys(self._select(values, first)))[: problem.members]
        self.sizes: list[int] = []
        self.stack = found.population.subset(founders)
        self.share = torch.full((len(founders),), 1 / len(founders), device=problem.device)
        self.training = StackedAdam(self.stack, problem.training.learning_rate)

    def step(self) -> float:
        """E-step and gradient steps of one generation; returns the loss."""
        problem, comparisons = self.problem, self.problem.comparisons
        likelihood = per_case(problem.likelihood(problem.compared_scores(self.stack)), comparisons)
        parts = [expect(likelihood[part], self.share[part]) for part in self._parts()]
        served = torch.cat([part.responsibility for part in parts])
        self.share = served[:, self.raters].mean(1)
        return descend_served(problem, self.stack, self.training, served, self.generator)

    def replace_unneeded(self) -> None:
        """Fill the places of members that nobody needs by children of selected parents."""
        likelihood = self._likelihood(self.judged)
        nested = nested_subsets(likelihood, self.judged.comparisons)
        most = max(1, int(_KEPT * self.problem.members))
        needed = min(int(nested.value.mean(1).argmax()) + 1, most)
        kept = sorted(nested.order[:needed])
        count = self.problem.members - needed
        if not count:
            return
        place = self._raters_to_serve(kept, count)
        margin = self.problem.margins(self.stack)[kept]
        values = case_values(margin > 0, self.problem.comparisons)[:, self.raters]
        parents = [kept[parent] for parent in self._select(values, place)]
        children = self.stack.subset(parents)
        personalise(
            self.problem.loss(children, cloning=False),
            self.problem.comparisons,
            self.raters[place],
            steps=self.popl.specialist_steps,
            learning_rate=_CHILD_RATE * self.problem.training.learning_rate,
            batch_size=_CHILD_BATCH,
            generator=self.generator,
        )
        fresh = self.share.new_full((count,), 1 / self.problem.members)
        share = torch.cat([self.share[kept], fresh])
        both = torch.cat([self.stack.members.data, children.members.data])
        source = [*kept, *range(len(self.stack), len(self.stack) + count)]
        self._become(self.stack.with_members(both[source].clone()), source, share / share.sum())

    def divide(self) -> None:
        """Go on with populations of several sizes side by side, the most useful members first."""
        order = nested_subsets(self._likelihood(self.judged), self.judged.comparisons).order
        self.sizes = sizes_up_to(len(order))
        source = [member for size in self.sizes for member in order[:size]]
        share = torch.cat([self.share.new_full((size,), 1 / size) for size in self.sizes])
        self._become(self.stack.subset(source), source, share)

    def members_of(self, index: int) -> list[int]:
        """Members of the population of one size that serve a rater at least."""
        part = self._parts()[index]
        served = self.share[part] * len(self.raters)
        # The most useful of all stays where none serves as much as a whole rater.
        alive = (served >= 1) | (served == served.max())
        return [part.start + int(member) for member in alive.nonzero()[:, 0]]

    def divisions(self) -> list[Division]:
        """The best division of the raters for each number of niches, by raters not learnt of."""
        alive = [self.members_of(index) for index in range(len(self.sizes))]
        populations = [(self.stack.subset(one), self.share[one]) for one in alive]
        return divisions(self.problem, self.judged, populations)

    def largest(self) -> Population:
        """The population of the largest size, as ``problem.members`` members.

        The first ones come again where there are fewer: tables have a column for each member.
        """
        members = range(len(self.stack))[self._parts()[-1]]
        return self.stack.subset([members[i % len(members)] for i in range(self.problem.members)])

    def share_of_largest(self) -> Tensor:
        """Share of the raters that each of its members serves, summing to 1."""
        return self.share[self._parts()[-1]]

    def _parts(self) -> list[slice]:
        """Where the population of each size is in the stack."""
        ends = torch.tensor(self.sizes or [len(self.stack)]).cumsum(0).tolist()
        return [slice(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]

    def _likelihood(self, problem: Problem) -> Tensor:
        """Log-likelihood of every answer under every member, ``[K, M]``, as catering reckons it.

        Without the conservatism of training, under which the chances of an answer and of its
        opposite do not sum to 1: that would count members that find all segments of a rater likely.
        """
        margin = problem.margins(self.stack)
        return answer_likelihood(margin, problem.comparisons, problem.training.slip)

    def _draw_raters(self, count: int) -> Tensor:
        """Places among the raters, ``[count]``."""
        shape, device = (count,), self.raters.device
        return torch.randint(len(self.raters), shape, generator=self.generator, device=device)

    def _raters_to_serve(self, kept: Sequence[int], count: int) -> Tensor:
        """For whom children are: every other one out of the third predicted worst, else anybody."""
        value = predicted(self._likelihood(self.problem)[kept], self.problem.comparisons)
        worst = value[self.raters].argsort()[: -(-len(self.raters) // 3)]
        place = self._draw_raters(count)
        place[::2] = worst[self._draw_raters(len(place[::2])) % len(worst)]
        return place

    def _select(self, values: Tensor, first: Tensor) -> list[int]:
        """A parent for each rater of ``first``, by what members are to all, ``[K, raters]``."""
        if self.rule is not None:
            chosen: Tensor = self.rule(values, len(first), generator=self.generator)
            return chosen.tolist()
        epsilon = parse_epsilon(self.popl.epsilon)
        tolerance = mad(values) if isinstance(epsilon, str) else epsilon
        found = lexicase_given_first(values, first, epsilon=tolerance, generator=self.generator)
        return found.parents.tolist()

    def _become(self, stack: Population, source: Sequence[int], share: Tensor) -> None:
        self.training = self.training.moved_to(stack, source)
        self.stack, self.share = stack, share

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on, but the generator."""
        return {
            "count": len(self.stack),
            "sizes": list(self.sizes),
            "members": self.stack.members.data.clone().to_dict(),
            "share": self.share.clone(),
            "training": self.training.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        count = int(state["count"])
        if count != len(self.stack):
            stack = self.stack.subset([0] * count)
            self.training, self.stack = StackedAdam(stack, self.training.learning_rate), stack
        self.sizes = [int(size) for size in state["sizes"]]
        self.stack.members.data.update_(state["members"])
        self.share = state["share"].clone()
        self.training.load_state_dict(state["training"])


def descend_served(
    problem: Problem,
    population: Population,
    training: StackedAdam,
    served: Tensor,
    generator: torch.Generator,
) -> float:
    """CPL steps of a generation, in which members learn from the raters whom they serve.

    Args:
        problem: What is to be learnt, and the recipe.
        population: K members, changed in place.
        training: Their optimiser.
        served: How much each member serves each rater, ``[K, C]``.
        generator: Source of batches, one for each member.

    Returns:
        The last step's loss, averaged over members.
    """
    comparisons = problem.comparisons
    return descend(
        problem.loss(population),
        training.optimizer,
        comparisons,
        steps=problem.block,
        batch_size=problem.training.batch_size,
        draws=by_case(comparisons, served, least=1e-9),
        generator=generator,
    )
