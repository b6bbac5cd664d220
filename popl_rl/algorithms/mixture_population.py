"""POPL without rater ids: lexicase selection among teams of policies.

When nobody knows which preferences came from one person, a single preference says little about
which policy it speaks for, and selecting single policies on single preferences keeps specialists
that win a case here and there. So the individual here is a *team*, a small mixture of policies
that together should explain whatever is preferred:

    p(preference) = sum_k share_k sigmoid(Delta_k)

Members of a team divide the preferences among themselves by responsibility and train on those they
speak for: EM (Dempster, Laird and Rubin, 1977), as in MaxMin-RLHF (Chakraborty et al., 2024), but
over policies and without being told how many groups there are. Teams are selected by lexicase on
small bundles of *held-out* preferences, and the smallest team that is as good as the best is the
result.
"""

import copy
import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.algorithms.variation import inherit_moments
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import Spec
from popl_rl.models.population import Population
from popl_rl.models.schedules import linear_decay
from popl_rl.models.scoring import margins
from popl_rl.models.sets import as_set
from popl_rl.selection.lexicase import lexicase_report
from popl_rl.selection.mad import mad
from popl_rl.selection.rules import Selection, report

__all__ = ["MixturePOPL", "MixtureSettings"]

_OUTLIERS = 0.05  # a held-out preference counts as noise with this chance at either end


@dataclass(frozen=True)
class MixtureSettings:
    """Settings of :class:`MixturePOPL`.

    Attributes:
        teams: Teams in the population.
        sizes: Sizes of the first teams, in turn. A start finds all groups in one case of seven or
            so, so most teams are as small as teams can be.
        generations: Generations to come.
        steps: Gradient steps per generation.
        block: Gradient steps from one look at who speaks for whom to the next.
        batch_size: Preferences per step, each member's own.
        learning_rate: Of Adam.
        alpha: Scale of the scores.
        conservatism: Lambda of the CPL loss.
        discount: Per-step discount of the scores.
        held_out: Share of the preferences that only selection sees.
        bundle: Held-out preferences per lexicase case.
        first_selection: Generation after which selection begins. Which start is on the way to the
            groups does not show before some 600 steps: earlier selection fills the population
            with copies of another.
        exchange: Chance that a further child swaps a member with another selected team.
        removal: Chance that a further child loses a member.
        polish_steps: Steps of the final, cross-fitted training of the chosen team.
        polish_batch_size: Preferences per step of that training, the same for all members.
        polish_alpha: Scale of the scores in it.
        polish_conservatism: Lambda of the CPL loss in it; 1 for reward functions.
        folds: Folds of it.
    """

    teams: int = 24
    sizes: tuple[int, ...] = (2, 2, 2, 3)
    generations: int = 24
    steps: int = 60
    block: int = 15
    batch_size: int = 256
    learning_rate: float = 2e-3
    alpha: float = 0.5
    conservatism: float = 0.9
    discount: float = 1.0
    held_out: float = 0.2
    bundle: int = 20
    first_selection: int = 14
    exchange: float = 0.15
    removal: float = 0.15
    polish_steps: int = 1000
    polish_batch_size: int = 1000
    polish_alpha: float = 0.25
    polish_conservatism: float = 0.8
    folds: int = 4


class MixturePOPL:
    """Evolves teams of policies; one generation is gradient steps, lexicase, exchange.

    Args:
        spec: Sizes of the policies.
        bank: Segments that the comparisons refer to.
        comparisons: M strict preferences; their cases are not looked at.
        settings: See :class:`MixtureSettings`.
        select: Rule that takes the place of lexicase selection among teams.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        population: ``teams * max(sizes)`` policies, team after team.
        active: Which of a team's places are taken, ``[teams, max(sizes)]`` bool.
        share: What share of the preferences each member speaks for, ``[teams, max(sizes)]``.
    """

    def __init__(
        self,
        spec: Spec,
        bank: SegmentBank,
        comparisons: Comparisons,
        *,
        settings: MixtureSettings,
        select: Selection | None = None,
        generator: torch.Generator,
    ) -> None:
        self.select = select
        self.spec, self.bank, self.settings = spec, bank, settings
        self.comparisons, self.generator = comparisons, generator
        self.generation = 0
        self.alpha, self.discount = settings.alpha, settings.discount
        self._counts = _visit_counts(bank, spec, settings.discount)
        device = bank.row.device
        places = max(settings.sizes)
        order = self._permutation(len(comparisons))
        cut = int(settings.held_out * len(comparisons))
        if cut < settings.bundle:
            raise ValueError(
                f"preferences must be enough to hold {settings.bundle} out of "
                f"{settings.held_out:.0%}, got {len(comparisons)}; collect more answers"
            )
        self.held, self.train = comparisons.rows(order[:cut]), comparisons.rows(order[cut:])
        sizes = [settings.sizes[team % len(settings.sizes)] for team in range(settings.teams)]
        taken = torch.tensor(sizes, device=device).unsqueeze(1)
        self.active = torch.arange(places, device=device) < taken
        self.share = self.active / taken
        count = settings.teams * places
        self.population = Population.create(spec, count, generator=generator).to(device)
        self.loss, self.optimizer = self._trainer(
            self.population, settings.alpha, settings.conservatism
        )

    def step(self) -> dict[str, float]:
        """Run one generation.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (share of held-out preferences that some
            member of the best team passes), ``mean_accuracy`` of all members on them,
            ``held_out_likelihood`` of the best team (mean log),
            ``selection_depth``, ``distinct`` teams, ``effective_parents``, ``team_size`` of the
            best team and ``loss``.
        """
        settings = self.settings
        value = math.nan
        for done in range(0, settings.steps, settings.block):
            value = descend(
                self.loss,
                self.optimizer,
                self.train,
                steps=min(settings.block, settings.steps - done),
                batch_size=settings.batch_size,
                # Nobody speaks for nothing: an empty place needs something to draw.
                weight=self._responsibility() + 1e-6,
                generator=self.generator,
            )
        self.generation += 1
        held, robust = self._held_out()
        best = int(robust.mean(1).argmax())
        passed = (held.unflatten(0, self.active.shape) > 0) & self.active.unsqueeze(-1)
        metrics = {
            "worst_rater_accuracy": float(passed[best].any(0).float().mean()),
            "mean_accuracy": float(passed[self.active].float().mean()),
            "held_out_likelihood": float(robust[best].mean()),
            "selection_depth": 0.0,
            "distinct": float(settings.teams),
            "effective_parents": float(settings.teams),
            "team_size": float(self.active[best].sum()),
            "loss": value,
        }
        if settings.first_selection <= self.generation < settings.generations:
            cases = self._bundles(robust)
            if self.select is None:
                selected = lexicase_report(
                    cases, settings.teams, epsilon=mad(cases), generator=self.generator
                )
            else:
                chosen = self.select(cases, settings.teams, generator=self.generator)
                selected = report(cases, chosen)
            self._replace(selected.parents)
            metrics["selection_depth"] = float(selected.depth.float().mean())
            metrics["distinct"] = float(selected.distinct)
            metrics["effective_parents"] = selected.effective
        return metrics

    def policies(self) -> HypothesisSet:
        """Choose the smallest team as good as the best, and polish it."""
        _, robust = self._held_out()
        behind = robust[robust.mean(1).argmax()] - robust
        # One-standard-error rule: a bigger team has to earn its members.
        error = behind.std(1) / behind.shape[1] ** 0.5
        size = self.active.sum(1)
        good = behind.mean(1) <= error
        smallest = good & (size == size[good].min())
        team = int(torch.where(smallest, robust.mean(1), -torch.inf).argmax())
        member = self.active[team].nonzero().squeeze(-1) + team * self.active.shape[1]
        share = self.share[team][self.active[team]]
        return self._polish(self.population.subset(member), share)

    def _polish(self, team: Population, share: Tensor) -> HypothesisSet:
        """Train a team on, with responsibilities that nobody gave to their own training data.

        ``folds + 1`` copies of the team train side by side. Copy f leaves fold f out and tells
        whom the preferences of fold f belong to; the last copy trains on everything. Without this
        every member would confirm what it has learnt by heart.
        """
        settings, everything = self.settings, self.comparisons
        count, size = len(everything), len(team)
        fold = self._permutation(count) % settings.folds
        row = torch.arange(count, device=fold.device)
        copies = team.subset(list(range(size)) * (settings.folds + 1))
        loss, optimizer = self._trainer(copies, settings.polish_alpha, settings.polish_conservatism)
        block = 50
        schedule = linear_decay(optimizer, -(-settings.polish_steps // block))
        use = torch.ones(settings.folds + 1, count, device=fold.device)
        use[fold, row] = 0.0
        use = use * count / use.sum(1, keepdim=True)
        log_share = share.clamp(min=1e-3).log().unsqueeze(-1)
        for _ in range(-(-settings.polish_steps // block)):
            margin = margins(
                copies, self.bank, everything, alpha=settings.polish_alpha, discount=self.discount
            )
            log_odds = F.logsigmoid(margin).unflatten(0, (settings.folds + 1, size))
            responsibility = (log_odds + log_share).softmax(1)[fold, :, row].T
            for _ in range(block):
                index = self._draw(everything)
                contrast = self._batch_margins(loss, index)
                weight = (use[:, None, index] * responsibility[:, index]).flatten(0, 1)
                _descend((F.softplus(-contrast) * weight).mean(1).sum(), optimizer)
            schedule.step()
        refined = copies.subset(list(range(settings.folds * size, len(copies))))
        policies = as_set(refined, alpha=settings.polish_alpha, discount=self.discount)
        policies.origin = []  # trained on, they are no longer members of the population
        return policies

    def _held_out(self) -> tuple[Tensor, Tensor]:
        """Margins ``[N, H]`` and robust log-likelihoods ``[teams, H]`` of held-out preferences."""
        held = margins(
            self.population, self.bank, self.held, alpha=self.alpha, discount=self.discount
        )
        likelihood = self._explain(F.logsigmoid(held)).exp()
        return held, (_OUTLIERS + (1 - 2 * _OUTLIERS) * likelihood).log()

    def _explain(self, log_odds: Tensor) -> Tensor:
        """Log-likelihood of preferences under each team, ``[N, B] -> [teams, B]``."""
        log_share = self.share.clamp(min=1e-3).log()
        log_share = log_share.masked_fill(~self.active, -torch.inf).unsqueeze(-1)
        explained: Tensor = log_odds.unflatten(0, self.active.shape) + log_share
        return explained.logsumexp(1)

    def _responsibility(self) -> Tensor:
        """Whom each member speaks for (the E-step), ``[N, M]``; shares become its means."""
        margin = margins(
            self.population, self.bank, self.train, alpha=self.alpha, discount=self.discount
        )
        log_odds = F.logsigmoid(margin).unflatten(0, self.active.shape)
        log_share = self.share.clamp(min=1e-3).log().masked_fill(~self.active, -torch.inf)
        belongs: Tensor = (log_odds + log_share.unsqueeze(-1)).softmax(1)
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

    def _trainer(
        self, population: Population, alpha: float, conservatism: float
    ) -> tuple[CPLLoss, torch.optim.Adam]:
        loss = CPLLoss(
            population,
            self.bank,
            alpha=alpha,
            conservatism=conservatism,
            discount=self.settings.discount,
        )
        rate = self.settings.learning_rate
        return loss, torch.optim.Adam(population.members.parameters(), lr=rate)

    def _batch_margins(self, loss: CPLLoss, index: Tensor) -> Tensor:
        """Conservative margins of every member on one shared batch, ``[N, B]``."""
        preferred, other = self.comparisons.preferred[index], self.comparisons.other[index]
        if self._counts is None:
            segment = torch.cat([preferred, other]).expand(len(loss.population), -1)
            better, worse = loss.scores(segment).chunk(2, dim=1)
            return better - loss.conservatism * worse
        # All members see the same batch of few distinct observations: one matrix product.
        table = self.spec.table(loss.population(self.bank.observation)).flatten(1)
        contrast = self._counts[preferred] - loss.conservatism * self._counts[other]
        batch: Tensor = loss.alpha * table @ contrast.T
        return batch

    def _draw(self, comparisons: Comparisons) -> Tensor:
        shape, device = (self.settings.polish_batch_size,), comparisons.preferred.device
        return torch.randint(len(comparisons), shape, generator=self.generator, device=device)

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
        """Continue from :meth:`state_dict`, bit for bit."""
        self.generation = int(state["generation"])
        self.population.members.data.update_(state["members"])
        self.active, self.share = state["active"].clone(), state["share"].clone()
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.generator.set_state(state["generator"].cpu())


def _visit_counts(bank: SegmentBank, spec: Spec, discount: float) -> Tensor | None:
    """Discounted visits of each segment to each (observation, action), ``[N, U * K]``."""
    if not (bank.is_shared and spec.discrete):
        return None
    cells = len(bank.observation) * spec.action_dim
    steps = torch.arange(bank.row.shape[1], device=bank.row.device)
    weight = (discount**steps).float().expand(bank.row.shape)
    counts = torch.zeros(len(bank), cells, device=bank.row.device)
    return counts.scatter_add(1, bank.row * spec.action_dim + bank.action, weight)


def _descend(loss: Tensor, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()
