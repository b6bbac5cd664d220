"""Low-rank reward functions: a few that all raters share, and how much of each a rater wants.

LoRe (Bose et al., 2025, arXiv 2504.14439): the reward of rater u is ``r_u = sum_b w_ub r_b``, with
B bases ``r_b`` and weights ``w_u`` on the simplex, learnt together. A new rater's few weights are
then fitted to few answers, the bases as they are. Here the bases are last layers on one trunk, so
that a mixture of them is a last layer too; of policies, logits or mean actions are mixed.
"""

import copy
from typing import Any

import torch
from torch import Tensor, nn

from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.vpl import spread_points
from popl_rl.config import LoReSettings
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import drawn_likelihood, log_likelihood
from popl_rl.models.schedules import linear_decay
from popl_rl.models.scoring import case_values, rater_accuracy
from popl_rl.optim import adam, take_step

__all__ = ["LoRe"]

_MOST = 64  # hypotheses in the set


class LoRe:
    """Trains bases and every rater's weights together, a block of steps for each generation.

    A step draws answers and descends their CPL loss (of reward functions: Bradley–Terry) under the
    weights of who gave them. Weights are a softmax of free numbers, which have a learning rate of
    their own, because a step meets each rater in few answers.

    Args:
        problem: What is to be learnt. With ``evolve="head"`` the trunk stays as it was drawn.
        lore: Number B of bases; learning rate of weights; steps in which a new rater's are fitted.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.
        bases: The B bases, as heads on a trunk.
        free: What the raters' weights are a softmax of, ``[C, B]``.

    Raises:
        ValueError: If members are to be style codes, every case is one preference, or there is no
            basis.
    """

    def __init__(self, problem: Problem, *, lore: LoReSettings, generator: torch.Generator) -> None:
        if problem.clone is not None:
            raise ValueError("method.evolve must be all or head for method lore, got code")
        if problem.comparisons.is_single:
            raise ValueError(
                "method lore needs rater ids, because each rater has weights of its own; use "
                "method.cases=rater with several answers of each"
            )
        if lore.bases < 1:
            raise ValueError(f"lore.bases must be at least 1, got {lore.bases}")
        self.problem, self.settings, self.generator = problem, lore, generator
        self.generation, self.generations = 0, problem.generations
        bases = Population.create(problem.spec, lore.bases, evolve="head", generator=generator)
        self.bases = bases.to(problem.device)
        shape, device = (problem.comparisons.num_cases, lore.bases), problem.device
        self.free = nn.Parameter(torch.randn(shape, generator=generator, device=device))
        learnt = list(self.bases.members.parameters())
        if problem.evolve == "all":
            learnt += self.bases.trunk.requires_grad_(True).parameters()
        self.optimizer = torch.optim.Adam(
            [
                {"params": learnt, "lr": problem.training.learning_rate},
                {"params": [self.free], "lr": lore.learning_rate},
            ]
        )
        self.schedule = linear_decay(self.optimizer, problem.generations)

    def step(self) -> dict[str, float]:
        """Run one generation: evaluate the set, then train.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over cases of the best
            hypothesis's accuracy) and ``mean_accuracy``, both as the generation found them,
            ``loss_cpl``, and ``effective_bases``, the exponentiated entropy of the mean weights.
        """
        passes = self.problem.margins(self.population) > 0
        said, size = self.problem.comparisons, self.problem.training.batch_size
        chance = said.weighted(torch.ones(len(said), device=self.problem.device))
        loss = torch.zeros(())
        for _ in range(self.problem.block):
            index = torch.multinomial(chance, size, replacement=True, generator=self.generator)
            weights = self.free[said.case[index]].softmax(1)
            rows = said.together(index).view(size, -1)
            pair = torch.cat([said.preferred[rows], said.other[rows]], 1)
            margin = self._margins(self._look(pair), pair, weights).flatten()
            slip = self.problem.training.slip
            loss = -drawn_likelihood(margin, said, index, slip).mean()
            take_step(self.optimizer, loss)
        self.schedule.step()
        self.generation += 1
        share = self.weights().mean(0)
        return {
            "worst_rater_accuracy": rater_accuracy(case_values(passes, said)),
            "mean_accuracy": float(passes.float().mean()),
            "loss_cpl": float(loss.detach()),
            "effective_bases": float(torch.special.entr(share).sum().exp()),
        }

    def _margins(self, seen: Tensor, pair: Tensor, weights: Tensor) -> Tensor:
        """CPL's margins of answers in the eyes of mixtures.

        Args:
            seen: What the bases say at the segments' steps, as of ``_look``.
            pair: Segments preferred, and behind them the others, of P raters, ``[P, 2 K]``.
            weights: Of the mixtures, ``[P, B]``.

        Returns:
            ``[P, K]``.
        """
        better, worse = self._scores(seen, pair, weights).chunk(2, 1)
        return better - self.problem.conservatism * worse

    def _look(self, segment: Tensor) -> Tensor:
        """Outputs of the bases at the steps of segments ``[P, K]``, ``[B, P, K * T, outputs]``."""
        bank = self.problem.bank
        output = self.bases(bank.observation[bank.row[segment].flatten()])
        seen: Tensor = output.unflatten(1, (len(segment), -1))
        return seen

    def _scores(self, seen: Tensor, segment: Tensor, weights: Tensor) -> Tensor:
        """Scores of segments ``[P, K]`` in the eyes of P mixtures ``[P, B]``, ``[P, K]``."""
        bank, recipe = self.problem.bank, self.problem.training
        mixed = torch.einsum("pb,bpnk->pnk", weights, seen)
        step = self.problem.spec.step_scores(mixed, bank.action[segment].flatten(1, 2))
        weight = recipe.alpha * bank.weights(segment, discount=recipe.discount)
        scores: Tensor = (step.view(*segment.shape, -1) * weight).sum(-1)
        return scores

    def fit(self, preferred: Tensor, other: Tensor, there: Tensor) -> Tensor:
        """Fit weights of new raters to their answers, with the bases as they are.

        Args:
            preferred: Segments that each of P raters preferred, ``[P, K]``.
            other: Segments that they preferred these to, ``[P, K]``.
            there: Which of the answers there are, ``[P, K]`` bool.

        Returns:
            Weights on the simplex, ``[P, B]``; of a rater without answers those of the mean rater.
        """
        start = self.weights().mean(0)
        if not bool(there.any()):
            return start.expand(len(preferred), -1)
        pair = torch.cat([preferred, other], 1)
        with torch.no_grad():
            seen = self._look(pair)
        free = start.log().repeat(len(preferred), 1).requires_grad_()
        optimizer = adam([free], lr=self.settings.learning_rate)
        for _ in range(self.settings.fit_steps):
            margin = self._margins(seen, pair, free.softmax(1))
            loss = -(log_likelihood(margin, self.problem.training.slip) * there).sum()
            take_step(optimizer, loss)
        # One without answers has no gradient, and stays where it began.
        return free.detach().softmax(1)

    def weights(self) -> Tensor:
        """Weights of the raters that were learnt from, ``[C, B]``."""
        return self.free.detach().softmax(1)

    @torch.no_grad()
    def mixtures(self, weights: Tensor) -> Population:
        """The hypotheses of raters with weights ``[N, B]``, as ordinary members."""
        evolve = self.problem.evolve
        single = Population([self.bases.network(0)], self.problem.spec, evolve=evolve)
        population = single.to(weights.device).subset([0] * len(weights))
        last = "0" if evolve == "head" else str(len(self.bases.trunk))
        for name, basis in self.bases.members.data["0"].items():
            mixed = torch.einsum("nb,b...->n...", weights, basis)
            population.members.data[last, name].copy_(mixed)
        return population

    @property
    def population(self) -> Population:
        """The hypotheses of raters who want what is far apart, as they are now."""
        weights = self.weights()
        return self.mixtures(weights[spread_points(weights, _MOST)])

    def result(self) -> HypothesisSet:
        """The hypotheses of raters who want what is far apart, to cater from as from any set."""
        return self.problem.calibrated(self.problem.hypothesis_set(self.population))

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "bases": copy.deepcopy(self.bases.state_dict()),
            "free": self.free.detach().clone(),
            # A copy: Adam's own state goes on changing in place.
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),
            "epoch": self.schedule.last_epoch,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.generation = int(state["generation"])
        self.bases.load_state_dict(state["bases"])
        self.free.data.copy_(state["free"])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.schedule.last_epoch = int(state["epoch"])
        self.generator.set_state(state["generator"].cpu())
