"""N policies, or reward functions, as one stack of parameters: score, clone, swap members."""

from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn

from popl_rl.policies import Spec, build_network
from popl_rl.segments import SegmentBank

__all__ = ["Population", "segment_scores"]


class Population(nn.Module):
    """Stacked policies, or reward functions, of one architecture.

    The layers of the members are multiplied together (``baddbmm``), which on a CPU is as fast as
    a loop over the members and faster than ``torch.vmap``; on a GPU it is one kernel per layer.

    Args:
        networks: One ``nn.Sequential`` of linear layers and element-wise activations per member.
        spec: Sizes the networks were built from.
        evolve: ``"all"``: every weight belongs to a member. ``"head"``: members differ in the last
            layer only; the layers before it are those of ``networks[0]``, shared and frozen.

    Attributes:
        trunk: Layers shared by all members; empty for ``evolve="all"``.
        members: The members' own parameters, a ``TensorDictParams`` of batch size ``[N]``.

    Raises:
        ValueError: If there are no networks or their architectures differ.
    """

    def __init__(
        self,
        networks: Sequence[nn.Sequential],
        spec: Spec,
        *,
        evolve: Literal["all", "head"] = "all",
    ) -> None:
        super().__init__()
        if not networks:
            raise ValueError("networks must hold at least one network, got none")
        kinds = {str(network) for network in networks}
        if len(kinds) > 1:
            raise ValueError(
                f"networks must share one architecture, got {' and '.join(sorted(kinds))}; build "
                "them all from one spec"
            )
        if evolve not in ("all", "head"):
            raise ValueError(f"evolve must be 'all' or 'head', got {evolve!r}")
        split = len(networks[0]) - 1 if evolve == "head" else 0
        self.spec = spec
        self.evolve = evolve
        self.trunk = nn.Sequential(*list(networks[0])[:split]).requires_grad_(False)
        # Sequential(*...) rather than a slice: it numbers the layers from 0.
        own = [nn.Sequential(*list(network)[split:]) for network in networks]
        self.members: TensorDictParams = TensorDict.from_modules(*own, as_module=True)
        self._activations = [
            None if isinstance(layer, nn.Linear) else layer for layer in list(networks[0])[split:]
        ]

    @classmethod
    def create(
        cls,
        spec: Spec,
        num_members: int,
        *,
        evolve: Literal["all", "head"] = "all",
        generator: torch.Generator,
    ) -> "Population":
        """Build ``num_members`` freshly initialised members."""
        if num_members < 1:
            raise ValueError(f"num_members must be at least 1, got {num_members}")
        networks = [build_network(spec, generator=generator) for _ in range(num_members)]
        return cls(networks, spec, evolve=evolve)

    def __len__(self) -> int:
        return int(self.members.batch_size[0])

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        device: torch.device = next(self.members.parameters()).device
        return device

    def forward(self, observation: Tensor) -> Tensor:
        """Logits, mean actions or rewards of every member.

        Args:
            observation: ``[R, O]`` seen by all members, or ``[N, R, O]``, each its own.

        Returns:
            ``[N, R, action_dim]``.
        """
        return self.from_features(self.trunk(observation))

    def from_features(self, features: Tensor) -> Tensor:
        """The members' own layers, applied to outputs of the trunk ``[R, F]`` or ``[N, R, F]``."""
        hidden = features if features.ndim == 3 else features.expand(len(self), *features.shape)
        for position, activation in enumerate(self._activations):
            if activation is not None:
                hidden = activation(hidden)
                continue
            layer = self.members[str(position)]
            bias, weight = layer.get("bias", None), layer["weight"].mT
            if bias is None:
                hidden = torch.bmm(hidden, weight)
            else:
                hidden = torch.baddbmm(bias.unsqueeze(1), hidden, weight)
        return hidden

    @torch.no_grad()
    def replace_(self, parents: Tensor) -> None:
        """Overwrite the members by copies of ``parents`` ``[N]``, in place."""
        self.members.data.update_(self.members.data[parents].clone())

    def subset(self, indices: Tensor | Sequence[int]) -> "Population":
        """Copies of some members, in the order of ``indices``."""
        return self.with_members(self.members.data[torch.as_tensor(indices)].clone())

    def with_members(self, members: TensorDictBase) -> "Population":
        """A population of the same architecture with other parameters (taken, not copied)."""
        clone = Population.__new__(Population)
        nn.Module.__init__(clone)
        clone.spec, clone.evolve, clone.trunk = self.spec, self.evolve, self.trunk
        clone.members = TensorDictParams(members)
        clone._activations = self._activations
        return clone

    def network(self, index: int) -> nn.Sequential:
        """Member ``index`` as an ordinary network with parameters of its own."""
        generator = torch.Generator().manual_seed(0)
        network = build_network(self.spec, generator=generator).to(self.device)
        split = len(self.trunk)
        network[:split].load_state_dict(self.trunk.state_dict())
        own = self.members.data[index].flatten_keys(".").to_dict()
        nn.Sequential(*list(network)[split:]).load_state_dict(own)
        return network


def _chunks(total: int, size: int) -> Iterator[slice]:
    for start in range(0, total, size):
        yield slice(start, min(start + size, total))


@torch.no_grad()
def segment_scores(
    population: Population,
    bank: SegmentBank,
    *,
    alpha: float = 1.0,
    discount: float = 1.0,
    memory_mb: float = 256.0,
) -> Tensor:
    """Score every segment once per member: ``S_n(sigma) = sum_t gamma^t alpha log pi_n(a_t|s_t)``.

    The score inside the CPL loss (arXiv 2310.13639, equation 5); for reward functions the sum of
    rewards, ``sum_t gamma^t alpha r_n(s_t, a_t)``. Observations that occur more than once in the
    bank are looked at once.

    Args:
        population: N members.
        bank: The segments.
        alpha: Temperature of CPL's maximum-entropy policies.
        discount: Per-step discount gamma.
        memory_mb: Bound on the temporaries, in MiB; work is cut into chunks that fit.

    Returns:
        ``[N, num_segments]`` float32.
    """
    count, steps = len(population), bank.row.shape[1]
    weight = alpha * discount ** torch.arange(steps, device=population.device).float()
    spec = population.spec
    width = max(spec.observation_dim, *spec.hidden, spec.action_dim, 1)
    budget = int(memory_mb * 2**20)
    scores = torch.empty(count, len(bank), device=population.device)
    if spec.discrete and bank.is_shared:
        # A table [N, U, K] of step scores answers for every step of every segment.
        member_bytes = 4 * (3 * width * len(bank.observation) + 4 * bank.row.numel())
        features = population.trunk(bank.observation)
        cell = (bank.row * spec.action_dim + bank.action).flatten()
        for part in _chunks(count, max(1, budget // member_bytes)):
            some = population.with_members(population.members.data[part])
            table = spec.table(some.from_features(features)).flatten(1)
            scores[part] = table[:, cell].view(-1, *bank.row.shape) @ weight
        return scores
    for part in _chunks(len(bank), max(1, budget // (4 * 3 * width * steps * count))):
        observation = bank.observation[bank.row[part]].flatten(0, 1)
        action = bank.action[part].flatten(0, 1)
        value = spec.step_scores(population(observation), action)
        scores[:, part] = value.view(count, -1, steps) @ weight
    return scores
