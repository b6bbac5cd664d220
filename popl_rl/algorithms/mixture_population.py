"""POPL without rater ids: lexicase selection among mixtures of policies.

When nobody knows which preferences came from one person, a single preference says little about
which policy it speaks for, and selecting single policies on single preferences keeps specialists
that win a case here and there. So the individual here is a small *mixture* of policies
that together should explain whatever is preferred:

    p(preference) = sum_k share_k sigmoid(Delta_k)

Members of a mixture divide the preferences among themselves by responsibility and train on those
they speak for: EM (Dempster, Laird and Rubin, 1977), as in MaxMin-RLHF (Chakraborty et al., 2024),
but over policies and without being told how many groups there are. Mixtures are selected by
lexicase on small bundles of *held-out* preferences, and the smallest mixture that is as good as the
best is the result.
"""

import copy
import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from popl_rl.algorithms.draws import by_comparison
from popl_rl.algorithms.expectation import Expectation, expect
from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.algorithms.needed import behind_best
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.variation import inherit_moments
from popl_rl.config import MixtureSettings
from popl_rl.data.bank import SegmentBank
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import Spec
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import log_likelihood
from popl_rl.models.schedules import linear_decay
from popl_rl.optim import adam, take_step
from popl_rl.selection.lexicase import lexicase_report
from popl_rl.selection.mad import mad
from popl_rl.selection.rules import Selection, report

__all__ = ["MixturePOPL"]

_FINAL_BLOCK = 50  # gradient steps of the final training from one E-step to the next

#: Sizes of the first mixtures, in turn. A start finds all groups in one case of seven or so, so
#: most mixtures are as small as mixtures can be.
_SIZES = (2, 2, 2, 3)
_OUTLIERS = 0.05  # a held-out preference counts as noise with this chance at either end


class MixturePOPL:
    """Evolves mixtures of policies; one generation is gradient steps, lexicase, exchange.

    Args:
        problem: What is to be learnt; the cases of its comparisons are not looked at.
        settings: Sizes and steps.
        select: Rule that takes the place of lexicase selection among mixtures.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.
        population: ``mixtures * places`` policies, mixture after mixture.
        active: Which of a mixture's places are taken, ``[mixtures, places]`` bool.
        share: What share of the preferences each member speaks for, ``[mixtures, places]``.

    Raises:
        ValueError: If there are too few preferences to hold some out.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        settings: MixtureSettings,
        select: Selection | None = None,
        generator: torch.Generator,
    ) -> None:
        # Slips of single answers would dissolve the mixtures: they are left out to the end.
        final = replace(problem.training, slip=settings.slip)
        search = replace(final, alpha=settings.alpha, conservatism=settings.conservatism)
        self.problem, self.settings = replace(problem, training=final), settings
        problem = replace(problem, training=search)
        self.select, self.generator = select, generator
        self.generation, self.generations = 0, settings.generations
        self._counts = _visit_counts(problem.bank, problem.spec, problem.training.discount)
        device, comparisons = problem.device, problem.comparisons
        order = self._permutation(len(comparisons))
        cut = int(settings.held_out * len(comparisons))
        if cut < settings.bundle:
            raise ValueError(
                f"preferences must be enough to hold {settings.bundle} out of "
                f"{settings.held_out:.0%}, got {len(comparisons)}; collect more answers"
            )
        self.held, self.train = (
            replace(problem, comparisons=comparisons.rows(part))
            for part in (order[:cut], order[cut:])
        )
        places = max(_SIZES)
        sizes = [_SIZES[mixture % len(_SIZES)] for mixture in range(settings.mixtures)]
        taken = torch.tensor(sizes, device=device).unsqueeze(1)
        self.active = torch.arange(places, device=device) < taken
        self.share = self.active / taken
        count = settings.mixtures * places
        self.population = Population.create(problem.spec, count, generator=generator).to(device)
        self.loss, self.optimizer = _trainer(problem, self.population)

    def step(self) -> dict[str, float]:
        """Run one generation.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (share of held-out preferences that some
            member of the best mixture passes), ``mean_accuracy`` of all members on them,
            ``held_out_likelihood`` of the best mixture (mean log),
            ``selection_depth``, ``distinct`` mixtures, ``effective_parents``, ``mixture_size`` of
            the best mixture and ``loss``.
        """
        settings = self.settings
        value = math.nan
        for done in range(0, settings.steps, settings.block):
            value = descend(
                self.loss,
                self.optimizer,
                self.train.comparisons,
                steps=min(settings.block, settings.steps - done),
                batch_size=self.problem.training.batch_size,
                draws=by_comparison(self.train.comparisons, self._responsibility()),
                generator=self.generator,
            )
        self.generation += 1
        passes, robust = self._held_out()
        best = int(robust.mean(1).argmax())
        passed = passes.unflatten(0, self.active.shape) & self.active.unsqueeze(-1)
        metrics = {
            "worst_rater_accuracy": float(passed[best].any(0).float().mean()),
            "mean_accuracy": float(passed[self.active].float().mean()),
            "held_out_likelihood": float(robust[best].mean()),
            "selection_depth": 0.0,
            "distinct": float(settings.mixtures),
            "effective_parents": float(settings.mixtures),
            "mixture_size": float(self.active[best].sum()),
            "loss": value,
        }
        if settings.first_selection <= self.generation < settings.generations:
            cases = self._bundles(robust)
            if self.select is None:
                selected = lexicase_report(
                    cases, settings.mixtures, epsilon=mad(cases), generator=self.generator
                )
            else:
                chosen = self.select(cases, settings.mixtures, generator=self.generator)
                selected = report(cases, chosen)
            self._replace(selected.parents)
            metrics["selection_depth"] = float(selected.depth.float().mean())
            metrics["distinct"] = float(selected.distinct)
            metrics["effective_parents"] = selected.effective
        return metrics

    def result(self) -> HypothesisSet:
        """The smallest mixture that is as good as the best, trained once more and scaled."""
        _, robust = self._held_out()
        behind = behind_best(robust)
        # One-standard-error rule: a bigger mixture has to earn its members.
        error = behind.std(1) / behind.shape[1] ** 0.5
        size = self.active.sum(1)
        good = behind.mean(1) <= error
        smallest = good & (size == size[good].min())
        chosen = int(torch.where(smallest, robust.mean(1), -torch.inf).argmax())
        places = self.active.shape[1]
        member = self.active[chosen].nonzero().squeeze(-1) + chosen * places
        share = self.share[chosen][self.active[chosen]]
        final = self._train_finally(self.population.subset(member), share)
        found = self.problem.hypothesis_set(final)
        found.origin = []  # trained on, they are no longer members of the population
        return found

    def _train_finally(self, members: Population, share: Tensor) -> Population:
        """Train a mixture on, with responsibilities that nobody gave to their own training data.

        ``folds + 1`` copies of the mixture train side by side. Copy f leaves fold f out and tells
        whom the preferences of fold f belong to; the last copy trains on everything. Without this
        every member would confirm what it has learnt by heart.
        """
        settings, everything = self.settings, self.problem.comparisons
        count, size = len(everything), len(members)
        fold = self._permutation(count) % settings.folds
        row = torch.arange(count, device=fold.device)
        copies = members.subset(list(range(size)) * (settings.folds + 1))
        loss, optimizer = _trainer(self.problem, copies)
        blocks = -(-settings.final_steps // _FINAL_BLOCK)
        schedule = linear_decay(optimizer, blocks)
        use = torch.ones(settings.folds + 1, count, device=fold.device)
        use[fold, row] = 0.0
        use = use * count / use.sum(1, keepdim=True)
        shares = share.expand(settings.folds + 1, -1)
        for _ in range(blocks):
            likelihood = self._likelihood(self.problem.margins(copies))
            belongs = expect(likelihood.unflatten(0, (settings.folds + 1, size)), shares)
            responsibility = belongs.responsibility[fold, :, row].T
            loss.num_answers = (use.unsqueeze(1) * responsibility).sum(2).flatten()
            for _ in range(_FINAL_BLOCK):
                index = self._draw(count)
                losses = self._shared_losses(loss, index)
                weight = (use[:, None, index] * responsibility[:, index]).flatten(0, 1)
                take_step(optimizer, (losses * weight).mean(1).sum())
            schedule.step()
        return copies.subset(list(range(settings.folds * size, len(copies))))

    def _held_out(self) -> tuple[Tensor, Tensor]:
        """Passes ``[N, H]`` and robust log-likelihoods ``[mixtures, H]`` of what is held out."""
        margin = self.held.margins(self.population)
        likelihood = self._expect(self._likelihood(margin)).evidence.exp()
        return margin > 0, (_OUTLIERS + (1 - 2 * _OUTLIERS) * likelihood).log()

    def _likelihood(self, margin: Tensor) -> Tensor:
        """Log-likelihood of answers with these margins, without any conservatism, ``[N, M]``."""
        return log_likelihood(margin, self.settings.slip)

    def _expect(self, likelihood: Tensor) -> Expectation:
        """E-step of every mixture; each preference is a case of its own."""
        each = likelihood.unflatten(0, self.active.shape)
        return expect(each, self.share, active=self.active)

    def _responsibility(self) -> Tensor:
        """Whom each member speaks for, ``[N, M]``; shares become its means."""
        belongs = self._expect(self._likelihood(self.train.margins(self.population))).responsibility
        self.share = belongs.mean(2)
        return belongs.flatten(0, 1)

    def _bundles(self, values: Tensor) -> Tensor:
        """Mean of held-out values over random bundles, ``[teams, cases]``."""
        cases = values.shape[1] // self.settings.bundle
        chosen = self._permutation(values.shape[1])[: cases * self.settings.bundle]
        bundles: Tensor = values[:, chosen].unflatten(1, (cases, -1))
        return bundles.mean(2)

    def _replace(self, parents: Tensor) -> None:
        """The first child of a parent is its copy; further ones exchange and lose members."""
        places = self.active.shape[1]
        source = parents.unsqueeze(1) * places + torch.arange(places, device=parents.device)
        active, share = self.active[parents].clone(), self.share[parents].clone()
        seen: set[int] = set()
        for child, parent in enumerate(parents.tolist()):
            if parent in seen:
                mine = active[child].nonzero().squeeze(-1)
                if self._chance() < self.settings.exchange:
                    other = int(parents[self._pick(len(parents))])
                    theirs = self.active[other].nonzero().squeeze(-1)
                    place = mine[self._pick(len(mine))]
                    source[child, place] = other * places + theirs[self._pick(len(theirs))]
                if len(mine) > 1 and self._chance() < self.settings.removal:
                    active[child, mine[self._pick(len(mine))]] = False
            seen.add(parent)
        share = share * active
        self.active, self.share = active, share / share.sum(1, keepdim=True)
        self.population.replace_(source.flatten())
        inherit_moments(self.optimizer, source.flatten())

    def _shared_losses(self, loss: CPLLoss, index: Tensor) -> Tensor:
        """Losses of every member on one shared batch, ``[N, B]``."""
        comparisons = self.problem.comparisons
        preferred, other = comparisons.preferred[index], comparisons.other[index]
        if self._counts is None:
            return loss.pairs(preferred, other)
        # All members see the same batch of few distinct observations: one matrix product.
        output = loss.population(self.problem.bank.observation)
        table = loss.alpha * self.problem.spec.table(output).flatten(1)
        better, worse = table @ self._counts[preferred].T, table @ self._counts[other].T
        return loss.losses(better, worse)

    def _draw(self, count: int) -> Tensor:
        shape, device = (self.settings.final_batch_size,), self.generator.device
        return torch.randint(count, shape, generator=self.generator, device=device)

    def _permutation(self, count: int) -> Tensor:
        return torch.randperm(count, generator=self.generator, device=self.generator.device)

    def _pick(self, count: int) -> int:
        return int(torch.randint(count, (), generator=self.generator, device=self.generator.device))

    def _chance(self) -> float:
        return float(torch.rand((), generator=self.generator, device=self.generator.device))

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "members": self.population.members.data.clone().to_dict(),
            "active": self.active.clone(),
            "share": self.share.clone(),
            # A copy: Adam's own state goes on changing in place.
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.generation = int(state["generation"])
        self.population.members.data.update_(state["members"])
        self.active, self.share = state["active"].clone(), state["share"].clone()
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.generator.set_state(state["generator"].cpu())


def _trainer(problem: Problem, population: Population) -> tuple[CPLLoss, torch.optim.Adam]:
    rate = problem.training.learning_rate
    return problem.loss(population), adam(population.members.parameters(), lr=rate)


def _visit_counts(bank: SegmentBank, spec: Spec, discount: float) -> Tensor | None:
    """Discounted visits of each segment to each (observation, action), ``[N, U * K]``."""
    if not (bank.is_shared and spec.discrete):
        return None
    cells = len(bank.observation) * spec.action_dim
    weight = bank.weights(slice(None), discount=discount).expand(bank.row.shape)
    counts = torch.zeros(len(bank), cells, device=bank.row.device)
    return counts.scatter_add(1, bank.row * spec.action_dim + bank.action, weight)
