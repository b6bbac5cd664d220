"""From an evolved population to the few policies that people get: which to keep, one last training.

Selection finds out who there is. What it leaves is many members that serve the same raters nearly
alike, each trained on whatever it was selected for last. `smallest_subset` keeps as few as
predict the raters as well as more of them do, and `refine` trains each on those whom it
serves: EM (Dempster, Laird and Rubin, 1977) from where evolution has ended, which has also told it
how many there are.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from popl_rl.algorithms.expectation import expect
from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.needed import behind_best, nested_subsets, sufficient
from popl_rl.algorithms.problem import Problem
from popl_rl.config import RefinementSettings
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import InParts, per_case
from popl_rl.optim import adam, take_step

__all__ = ["refine", "smallest_subset"]

_CUTS = (0.2, 0.4)  # of the steps, after which members that nobody needs are dropped
_LOOKS = 30  # E-steps, one before each block of gradient steps


def smallest_subset(
    likelihood: Tensor | InParts, comparisons: Comparisons, *, most: int = 8
) -> list[int]:
    """As few members as predict the raters as well as more of them do.

    Of the `nested_subsets` the smallest within one standard error of the best is taken (Breiman et
    al., 1984): a further member has to earn its place.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[N, M]``, at once or in
            parts.
        comparisons: The M comparisons and the case of each.
        most: Size of the largest subset.

    Returns:
        Members, the most useful one first.
    """
    order, value = nested_subsets(likelihood, comparisons, most=most)
    return order[: sufficient(behind_best(value), evidence=1.0, negligible=0.0) + 1]


def refine(
    problem: Problem,
    population: Population,
    *,
    settings: RefinementSettings,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
) -> Population:
    """Choose a few members and train each on the raters whom it serves.

    ``folds + 1`` copies of the chosen members train side by side. Copy f leaves the cases of fold f
    out and tells who serves them; the last copy trains on everything and is the result. Without
    this every member would confirm what it has learnt by heart. The same held-out likelihoods tell,
    twice in the first half, which members nobody needs.

    The E-step and the gradient steps maximise one likelihood, that of answers with slips on CPL's
    conservative margins ``S(sigma+) - lambda S(sigma-)``, under the recipe of the problem.

    Args:
        problem: What is to be learnt; batches are shared by all members.
        population: N evolved members; copied.
        settings: Steps, folds and the most members to begin with.
        generator: Source of folds and batches.
        progress: Called with the number of steps done, now and then.

    Returns:
        At most ``settings.most`` members.
    """
    training = _CrossFitting(problem, population, settings, generator)
    blocks = min(_LOOKS, settings.steps)
    steps = [settings.steps * (block + 1) // blocks for block in range(blocks)]
    cuts = {int(cut * blocks) for cut in _CUTS}
    for block, (begin, end) in enumerate(zip([0, *steps[:-1]], steps, strict=True)):
        if block in cuts:
            training.drop()
        training.expect()
        # The learning rate is held for half of the blocks, then falls to zero.
        training.descend(end - begin, rate=min(1.0, 2 - 2 * block / blocks))
        if progress is not None:
            progress(end)
    return training.result()


class _CrossFitting:
    """``folds + 1`` copies of a few members, each but the last without one fold of the cases."""

    def __init__(
        self,
        problem: Problem,
        population: Population,
        settings: RefinementSettings,
        generator: torch.Generator,
    ) -> None:
        self.problem, self.generator = problem, generator
        comparisons, device = problem.comparisons, problem.device
        self.folds = settings.folds
        order = torch.randperm(comparisons.num_cases, generator=generator, device=device)
        self.fold = order % settings.folds
        self.case = torch.arange(comparisons.num_cases, device=device)
        self.size = comparisons.sizes().float()
        self.copy = torch.arange(settings.folds + 1, device=device)
        likelihood = self._likelihood(population)
        chosen = smallest_subset(likelihood, comparisons, most=settings.most)
        self.share = torch.full((len(chosen),), 1 / len(chosen), device=device)
        self.served = torch.ones(len(chosen), comparisons.num_cases, device=device)
        self._train(population.subset(chosen * (settings.folds + 1)))

    def _train(self, copies: Population) -> None:
        self.copies = copies
        self.loss: CPLLoss = self.problem.loss(copies)
        rate = self.problem.training.learning_rate
        self.optimizer = adam(copies.members.parameters(), lr=rate)

    def _likelihood(self, population: Population) -> InParts:
        """Log-likelihood of every comparison under every member, ``[N, M]``."""
        return self.problem.likelihood_in_parts(self.problem.compared_scores(population))

    def _by_copy(self, value: Tensor) -> Tensor:
        """Values of members ``[N, ...]`` by copy and member."""
        return value.unflatten(0, (self.folds + 1, -1))  # type: ignore[no-any-return]

    def drop(self) -> None:
        """Keep the members that held-out answers need."""
        comparisons = self.problem.comparisons
        likelihood = self._likelihood(self.copies)

        def held_out(part: slice) -> Tensor:
            case = comparisons.case[part]
            row = torch.arange(len(case), device=case.device)
            return self._by_copy(likelihood.part(part))[self.fold[case], :, row].T

        untold = InParts(len(self.share), held_out)
        kept: Sequence[int] = sorted(smallest_subset(untold, comparisons))
        index = torch.arange(len(self.copies), device=self.share.device)
        index = index.view(self.folds + 1, -1)[:, kept]
        self.share = self.share[kept]
        self._train(self.copies.subset(index.flatten()))

    def expect(self) -> None:
        """E-step: whom each member serves, told by copies that have not seen the case."""
        likelihood = self._by_copy(
            per_case(self._likelihood(self.copies), self.problem.comparisons)
        )
        self.served = expect(likelihood, self.share).responsibility[self.fold, :, self.case].T
        self.share = self.served.mean(1)
        self.loss.num_answers = self._weight(self.case) @ self.size

    def _weight(self, case: Tensor) -> Tensor:
        """How much comparisons of cases ``[B]`` count for each copy of a member, ``[N, B]``."""
        is_used = (self.fold[case] != self.copy.unsqueeze(1)).float()
        return (is_used.unsqueeze(1) * self.served[:, case]).flatten(0, 1)

    def descend(self, steps: int, *, rate: float) -> None:
        """Gradient steps on batches that all copies share."""
        training, comparisons = self.problem.training, self.problem.comparisons
        self.optimizer.param_groups[0]["lr"] = training.learning_rate * rate
        shape, device = (training.batch_size,), self.share.device
        for _ in range(steps):
            index = torch.randint(len(comparisons), shape, generator=self.generator, device=device)
            losses = self.loss.answers(comparisons, index)
            weight = self._weight(comparisons.case[index])
            if comparisons.weight is not None:
                weight = weight * comparisons.weight[index]
            loss = (losses * weight).mean(1).sum()
            take_step(self.optimizer, loss)
            self.copies.constrain_()

    def result(self) -> Population:
        """The copies that were trained on everything."""
        count = len(self.copies)
        return self.copies.subset(range(count - len(self.share), count))
