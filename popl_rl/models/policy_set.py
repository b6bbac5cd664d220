"""A set of policies: acting, TorchRL actors."""

from typing import cast

import torch
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import PolicySpec, build_actor

__all__ = ["PolicySet"]


class PolicySet(HypothesisSet):
    """Policies of which every hidden group should find its own.

    Args:
        population: The policies.
        alpha: Scale of their scores, as trained.
        discount: Per-step discount of their scores.

    Attributes:
        origin: Member of the trained population that each policy is; empty if it is none of them.

    Example:
        >>> policies = PolicySet.load("runs/mine/policies")  # doctest: +SKIP
        >>> choice = policies.cater(segments, answers)  # doctest: +SKIP
        >>> action = policies.act(observation, member=choice.member)  # doctest: +SKIP
    """

    folder = "policies"
    _kind = "policy"
    _spec = PolicySpec

    @torch.no_grad()
    def act(
        self,
        observation: Tensor,
        *,
        member: int | None = None,
        greedy: bool = False,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Choose actions.

        Args:
            observation: ``[O]`` or ``[B, O]``; without ``member`` also ``[N, B, O]``, each policy
                its own. Where policies act on features (``env.features``), images of uint8 as the
                environment shows them, ``[H, W, C]`` or ``[B, H, W, C]``, will do; what is shown
                and not uint8 has to be given to ``population.spec.seen`` first.
            member: Whose actions; every policy's if None.
            greedy: Take the most likely action rather than sample. Continuous policies always
                give their mean.
            generator: Needed to sample.

        Returns:
            Actions as the environment takes them, ``[...]`` (discrete) or ``[..., A]``, with ``N``
            in front if ``member`` is None.

        Raises:
            IndexError: If there is no such member.
            ValueError: If it must sample without a generator, or the extractor of the features
                cannot be found.
        """
        spec = cast("PolicySpec", self.population.spec)
        if observation.dtype == torch.uint8:
            observation = spec.seen(observation)
        single = observation.ndim == 1
        batch = observation.unsqueeze(0) if single else observation
        if member is None:
            output: Tensor = self.population(batch)
        else:
            if not 0 <= member < len(self):
                raise IndexError(f"member must be in 0..{len(self) - 1}, got {member}")
            output = self.population.subset([member])(batch)[0]
        if not spec.discrete:
            action = output
        elif greedy:
            action = spec.first_action + output.argmax(-1)
        elif generator is None:
            raise ValueError("generator must be given to sample actions; or pass greedy=True")
        else:
            flat = output.softmax(-1).flatten(0, -2)
            drawn = torch.multinomial(flat, 1, generator=generator).view(output.shape[:-1])
            action = spec.first_action + drawn
        return action.squeeze(-1 if spec.discrete else -2) if single else action

    def actor(self, member: int) -> ProbabilisticActor:
        """One policy as a TorchRL actor, for collectors and further training.

        Its actions are those of the environment. TorchRL's own wrappers of Gymnasium take
        ``Discrete(n, start)`` for ``0..n - 1`` in specs and random actions.
        """
        return build_actor(
            cast("PolicySpec", self.population.spec), self.population.network(member)
        )
