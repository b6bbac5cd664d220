"""A policy for every rater, by a latent variable that is read off the rater's answers.

In the spirit of variational preference learning (VPL; Poddar et al., 2024, arXiv 2408.10075), with
policies trained by CPL in the place of reward functions: an encoder of the *set* of a rater's
answers gives a belief ``q(z | answers)`` about what the rater wants, and one policy
``pi(a | s, z)`` serves everybody. For each z that is an ordinary policy: what z adds to the first
layer is a bias. So the result is a set of policies as everywhere here, at the beliefs about some
raters.
"""

import copy
from dataclasses import replace
from typing import Any, cast

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.draws import by_case
from popl_rl.algorithms.losses import answer_losses, cloning_weight
from popl_rl.algorithms.problem import Problem
from popl_rl.config import VPLSettings
from popl_rl.models.encoded_policy_set import AnswerEncoder, EncodedPolicySet, EncodedRewardSet
from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.schedules import linear_decay
from popl_rl.models.scoring import rater_accuracy
from popl_rl.optim import adam, take_step
from popl_rl.selection.farthest_first import farthest_first

__all__ = ["VPL", "active_units", "divergence", "spread_points", "swap_guidance"]

_MOST = 64  # policies in the set
_ACTIVE = 0.01  # variance over raters from which on a number of z says something


def divergence(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL divergence of N(mean, std) from N(0, 1), summed over the last dimension, ``[...]``."""
    return ((2 * log_std).exp() + mean.square() - 1 - 2 * log_std).sum(-1) / 2


def swap_guidance(mean: Tensor, log_std: Tensor, swapped: tuple[Tensor, Tensor]) -> Tensor:
    """How far beliefs are from mirrored ones about raters who said the opposite, ``[...]``.

    After swap-guided preference learning (SPL; Kim and Kim, 2026, arXiv 2603.12595), against a
    collapse of all beliefs into one: one belief for everybody cannot be its own mirror image.

    Args:
        mean: ``[..., L]``.
        log_std: ``[..., L]``.
        swapped: The same of the beliefs after all answers were swapped.

    Returns:
        ``1 + cos`` of the two means, 0 where they are opposed, plus the mean squared difference of
        the logarithms of the standard deviations, which should be alike.
    """
    opposite, log_opposite = swapped
    apart = 1 + F.cosine_similarity(mean, opposite, dim=-1)
    return apart + (log_std - log_opposite).square().mean(-1)


def active_units(mean: Tensor) -> int:
    """Numbers of z that differ between raters (Burda et al., 2016, arXiv 1509.00519).

    Args:
        mean: The mean of the belief about each rater, ``[C, L]``.

    Returns:
        How many have a variance over raters above 0.01; 0 if all beliefs have collapsed into one.
    """
    return int((mean.var(0, correction=0) > _ACTIVE).sum())


def spread_points(points: Tensor, count: int) -> Tensor:
    """Choose points far from each other: farthest first, from the one farthest from the middle.

    Args:
        points: ``[C, L]``.
        count: Points to choose; all if there are no more.

    Returns:
        Different rows, ``[min(count, C)]``, int64.
    """
    return farthest_first(
        lambda some, others: -(points[some, None] - points[others]).norm(dim=-1),
        len(points),
        min(count, len(points)),
        first=int((points - points.mean(0)).norm(dim=1).argmax()),
        device=points.device,
    )


class VPL:
    """Trains encoder and policy together, a block of steps for each generation.

    A step draws some raters and some answers of each, and descends the negated evidence lower
    bound with CPL's likelihood: the CPL loss of these answers at a z drawn from the encoder's
    belief, plus the belief's divergence from N(0, 1).

    Args:
        problem: What is to be learnt. Its batch size, divided by the answers of a rater, makes the
            number of raters in a batch.
        vpl: Length L of z; weight of the divergence, where 1 is the bound itself, under which three
            groups shared one number of z on two doors and blurred; weight of the guidance by
            swapped answers; answers of each rater, drawn with replacement.
        generator: Source of all randomness.

    Attributes:
        generation: Generations done so far.
        generations: Generations after which it is finished.

    Raises:
        ValueError: If hypotheses have no bias that z could be, or style codes, every case is one
            preference, ``latent`` is below 1, or ``kl`` or ``swap`` negative.
    """

    def __init__(self, problem: Problem, *, vpl: VPLSettings, generator: torch.Generator) -> None:
        if not problem.spec.hidden and not problem.spec.output_bias:
            raise ValueError(
                "method vpl needs a hidden layer, to whose inputs z is added; set method.hidden, "
                "such as method.hidden=[32]"
            )
        if problem.clone is not None or problem.evolve != "all":
            raise ValueError(
                "method.evolve must be all for method vpl, whose z takes the place of a style code"
            )
        if problem.comparisons.is_single:
            raise ValueError(
                "method vpl needs rater ids, because its encoder reads what one rater said; use "
                "method.cases=rater with several answers of each"
            )
        if vpl.latent < 1:
            raise ValueError(f"vpl.latent must be at least 1, got {vpl.latent}")
        if not vpl.kl >= 0:
            raise ValueError(f"vpl.kl must be at least 0, got {vpl.kl}")
        if not vpl.swap >= 0:
            raise ValueError(f"vpl.swap must be at least 0, got {vpl.swap}")
        self.swap = vpl.swap
        self.problem, self.spec = problem, cast("PolicySpec | RewardSpec", problem.spec)
        self.kl, self.answers, self.latent = vpl.kl, vpl.answers, vpl.latent
        self.raters = max(1, problem.training.batch_size // vpl.answers)
        self.generator = generator
        self.generation, self.generations = 0, problem.generations
        self.encoder = AnswerEncoder(self.spec, vpl.latent, generator=generator).to(problem.device)
        conditioned = replace(self.spec, observation_dim=self.spec.observation_dim + vpl.latent)
        self.network = build_network(conditioned, generator=generator).to(problem.device)
        parameters = [*self.encoder.parameters(), *self.network.parameters()]
        self.optimizer = adam(parameters, lr=problem.training.learning_rate)
        self.schedule = linear_decay(self.optimizer, problem.generations)

    def step(self) -> dict[str, float]:
        """Run one generation: judge the policies, then train.

        Returns:
            Scalars to log: ``worst_rater_accuracy`` (10 % quantile over cases of the best policy's
            accuracy), ``mean_accuracy`` and ``active_units``, as the generation found them,
            ``loss_cpl`` and ``divergence``.
        """
        passed = self.problem.pass_shares(self.population)
        active = active_units(self.beliefs())
        loss, apart = torch.zeros(2)
        for _ in range(self.problem.block):
            loss, apart, mirrored = self._losses()
            bound = loss + self.kl * apart / self.answers + self.swap * mirrored
            take_step(self.optimizer, bound)
        self.schedule.step()
        self.generation += 1
        return {
            "worst_rater_accuracy": rater_accuracy(passed.values),
            "mean_accuracy": passed.mean,
            "loss_cpl": float(loss.detach()),
            "divergence": float(apart.detach()),
            "active_units": float(active),
        }

    def _losses(self) -> tuple[Tensor, Tensor, Tensor]:
        """CPL loss of an answer, divergence and guidance of a rater's belief, of a fresh batch."""
        source, said = self.generator, self.problem.comparisons
        rater = torch.randint(
            said.num_cases, (self.raters,), generator=source, device=self.problem.device
        )
        index = by_case(said, F.one_hot(rater, said.num_cases).float(), least=0.0)(
            self.answers, source
        )
        preferred, other = said.preferred[index], said.other[index]
        mean, log_std = self.encoder(self.problem.bank, preferred, other)
        noise = torch.randn(mean.shape, generator=source, device=mean.device)
        z = mean + log_std.exp() * noise
        rows = said.together(index)
        better, worse = (self.scores(side[rows], z) for side in (said.preferred, said.other))
        recipe = self.problem.training
        loss = answer_losses(
            better,
            worse,
            said,
            index,
            conservatism=self.problem.conservatism,
            slip=recipe.slip,
            cloning=cloning_weight(
                self.spec.cloning(recipe.bc),
                len(said),
                alpha=recipe.alpha,
                bank=self.problem.bank,
            ),
        ).mean()
        mirrored = torch.zeros_like(loss)
        if self.swap > 0:
            swapped = self.encoder(self.problem.bank, other, preferred)
            mirrored = swap_guidance(mean, log_std, swapped).mean()
        return loss, divergence(mean, log_std).mean(), mirrored

    def scores(self, segment: Tensor, z: Tensor) -> Tensor:
        """Scores of segments ``[B, K]`` by the policies for z ``[B, L]``, ``[B, K]``."""
        bank, recipe = self.problem.bank, self.problem.training
        observation = bank.observation[bank.row[segment]]
        wants = z[:, None, None].expand(*observation.shape[:-1], -1)
        output = self.network(torch.cat([observation, wants], -1))
        step = self.spec.step_scores(output, bank.action[segment])
        weight = recipe.alpha * bank.weights(segment, discount=recipe.discount)
        if weight.ndim > 1:
            return (step * weight).sum(-1)
        scores: Tensor = step @ weight
        return scores

    @torch.no_grad()
    def beliefs(self) -> Tensor:
        """The encoder's mean for every rater, from all of the rater's answers, ``[C, L]``."""
        said = self.problem.comparisons
        pair = [
            self.encoder.segments(self.problem.bank, side) for side in (said.preferred, said.other)
        ]
        embedded = self.encoder.answer(torch.cat(pair, -1)).relu()
        total = embedded.new_zeros(said.num_cases, embedded.shape[1])
        total.index_add_(0, said.case, embedded)
        count = said.case.bincount(minlength=said.num_cases).unsqueeze(1)
        mean: Tensor = self.encoder.belief(total / count).chunk(2, -1)[0]
        return mean

    @torch.no_grad()
    def policies_for(self, z: Tensor) -> Population:
        """The policies for z ``[N, L]`` as ordinary networks."""
        weight = self.network.state_dict()
        seen, wants = weight["0.weight"].split([self.spec.observation_dim, z.shape[1]], 1)
        own = build_network(self.spec, generator=torch.Generator().manual_seed(0)).to(z.device)
        own.load_state_dict({**weight, "0.weight": seen})
        population = Population([own], self.spec).subset([0] * len(z))
        population.members.data["0", "bias"] += z @ wants.T
        return population

    @property
    def population(self) -> Population:
        """The policies of the set as it is now."""
        return self.policies_for(self._z())

    def result(self) -> EncodedPolicySet | EncodedRewardSet:
        """A set of hypotheses for what different raters want."""
        z = self._z()
        encoder = copy.deepcopy(self.encoder).requires_grad_(False)
        kind = EncodedPolicySet if isinstance(self.spec, PolicySpec) else EncodedRewardSet
        return kind(
            self.policies_for(z),
            encoder=encoder,
            z=z,
            alpha=self.problem.training.alpha,
            discount=self.problem.training.discount,
        )

    def _z(self) -> Tensor:
        beliefs = self.beliefs()
        return beliefs[spread_points(beliefs, _MOST)]

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {
            "generation": self.generation,
            "encoder": copy.deepcopy(self.encoder.state_dict()),
            "network": copy.deepcopy(self.network.state_dict()),
            # A copy: Adam's own state goes on changing in place.
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),
            "epoch": self.schedule.last_epoch,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit."""
        self.generation = int(state["generation"])
        self.encoder.load_state_dict(state["encoder"])
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.schedule.last_epoch = int(state["epoch"])
        self.generator.set_state(state["generator"].cpu())
