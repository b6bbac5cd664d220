"""Hypotheses for different z, with the encoder that tells which z a new rater wants (VPL)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self, cast

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.hypothesis_set import Catered, HypothesisSet
from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.reward_set import RewardSet
from popl_rl.storage import load_tensordict, save_tensordict

__all__ = ["AnswerEncoder", "EncodedPolicySet", "EncodedRewardSet"]


class AnswerEncoder(nn.Module):
    """What a rater wants, as a belief ``N(mean, std)`` about z, from any number of answers.

    Steps are embedded and averaged over a segment, the two segments of an answer are joined, and
    answers are embedded and averaged: neither the order of answers nor their number matters.

    Args:
        spec: Sizes of observations and actions.
        latent: Length L of z.
        units: Units of each hidden layer.
        generator: Source of the initial weights.
    """

    def __init__(
        self,
        spec: PolicySpec | RewardSpec,
        latent: int,
        *,
        units: int = 64,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.spec = spec
        wide = spec.observation_dim + spec.action_dim
        # Networks of these sizes; what their outputs mean is our affair.
        layers = [
            build_network(PolicySpec(inputs, outputs, True, hidden), generator=generator)
            for inputs, outputs, hidden in (
                (wide, units, ()),
                (2 * units, units, ()),
                (units, 2 * latent, (units,)),
            )
        ]
        self.step, self.answer, self.belief = layers

    def segments(self, bank: SegmentBank, segment: Tensor) -> Tensor:
        """Embedded segments, ``[...]`` -> ``[..., units]``."""
        action = bank.action[segment]
        if self.spec.discrete:
            action = F.one_hot(action, self.spec.action_dim).float()
        steps = torch.cat([bank.observation[bank.row[segment]], action], -1)
        embedded: Tensor = self.step(steps).relu()
        if bank.mask is None:
            return embedded.mean(-2)
        there = bank.mask[segment].unsqueeze(-1)
        return (embedded * there).sum(-2) / there.sum(-2)

    def forward(self, bank: SegmentBank, preferred: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        """The belief about raters.

        Args:
            bank: What the answers are about.
            preferred: Segments that each of B raters preferred, ``[B, K]``.
            other: Segments that they preferred these to, ``[B, K]``.

        Returns:
            Mean and log standard deviation, each ``[B, L]``.
        """
        pair = torch.cat([self.segments(bank, preferred), self.segments(bank, other)], -1)
        mean, log_std = self.belief(self.answer(pair).relu().mean(-2)).chunk(2, -1)
        return mean, log_std.clamp(-5, 2)


class _Encoded(HypothesisSet):
    """What sets of policies and of reward functions for different z share."""

    def __init__(
        self,
        population: Population,
        *,
        encoder: AnswerEncoder,
        z: Tensor,
        alpha: float = 0.5,
        discount: float = 1.0,
    ) -> None:
        super().__init__(population, alpha=alpha, discount=discount)
        self.encoder = encoder
        self.z = z

    @torch.no_grad()
    def cater(
        self,
        segments: TensorDictBase | SegmentBank,
        answers: TensorDictBase,
        *,
        method: Literal["posterior", "lexicase"] = "posterior",
        mistake: float = 0.05,
        scores: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Catered:
        """Choose a hypothesis for one rater from a few answers.

        Args:
            segments: What the answers are about.
            answers: As for ``HypothesisSet.cater``; none gives the fair choice there too.
            method: ``"posterior"``: belief ``w_n ~ q(z_n | answers)`` of the encoder, and the one
                believed in most, the nearest in units of the encoder's standard deviations.
                ``"lexicase"``: as ``HypothesisSet.cater``.
            mistake: Not used.
            scores: As for ``HypothesisSet.cater``; used by ``"lexicase"`` alone.
            generator: Source of the lexicase draw.

        Raises:
            ValueError: If no answer is strict, or the arguments are off.
        """
        if method != "posterior" or not len(answers):
            how: dict[str, Any] = {"method": method, "mistake": mistake, "scores": scores}
            return super().cater(segments, answers, generator=generator, **how)
        comparisons = Comparisons.from_preferences(answers, cases="preference")
        device = self.population.device
        bank = segments if isinstance(segments, SegmentBank) else self._bank(segments)
        said = comparisons.to(device)
        mean, log_std = self.encoder(bank.to(device), said.preferred[None], said.other[None])
        distance = ((self.z - mean) / log_std.exp()).square().sum(1).cpu()
        return Catered(int(distance.argmin()), (-distance / 2).softmax(0))

    def subset(self, members: Sequence[int]) -> Self:
        """Some of them, in the given order."""
        chosen = type(self)(
            self.population.subset(members),
            encoder=self.encoder,
            z=self.z[torch.as_tensor(members)],
            alpha=self.alpha,
            discount=self.discount,
        )
        self._tell(chosen, members)
        return chosen

    def _write_more(self, folder: Path) -> None:
        """Encoder and z, as tensors."""
        encoder = TensorDict(dict(self.encoder.state_dict()), [])
        save_tensordict(TensorDict({"z": self.z, "encoder": encoder}, []), folder / "encoder")

    @classmethod
    def _assemble(
        cls,
        population: Population,
        path: Path,
        *,
        digest: str | None,
        alpha: float,
        discount: float,
    ) -> Self:
        kept = load_tensordict(path / "encoder", required={"z": 2, "encoder": 0}, digest=digest)
        z = kept["z"]
        if len(z) != len(population):
            raise ValueError(f"there are {len(z)} z for {len(population)} members")
        spec = cast("PolicySpec | RewardSpec", population.spec)
        generator = torch.Generator().manual_seed(0)
        encoder = AnswerEncoder(spec, z.shape[1], generator=generator).requires_grad_(False)
        encoder.load_state_dict(dict(kept["encoder"].items()))
        return cls(population, encoder=encoder, z=z, alpha=alpha, discount=discount)


class EncodedPolicySet(_Encoded, PolicySet):
    """Policies for different z, of which a new rater is given the one that an encoder believes in.

    Args:
        population: N policies.
        encoder: Tells what a rater wants.
        z: For which z the policies are, ``[N, L]``.
        alpha: Scale of their scores, as trained.
        discount: Per-step discount of their scores.
    """

    _kind = "encoded_policy"


class EncodedRewardSet(_Encoded, RewardSet):
    """Reward functions for different z, likewise.

    Args:
        population: N reward functions.
        encoder: Tells what a rater wants.
        z: For which z the reward functions are, ``[N, L]``.
        alpha: Scale of their scores, as trained.
        discount: Per-step discount of their scores.
    """

    _kind = "encoded_reward"
