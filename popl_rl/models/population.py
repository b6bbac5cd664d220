"""N policies, or reward functions, as one stack of parameters: score, clone, swap members."""

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn

from popl_rl.data.bank import SegmentBank
from popl_rl.models.layers import Layer, activation, apply_layers
from popl_rl.models.policies import Spec, build_network
from popl_rl.models.trunk_cache import TrunkCache

__all__ = ["Population", "added_up"]


def added_up(value: Tensor, weight: Tensor) -> Tensor:
    """Sums over steps ``[..., T] -> [...]``, with weights ``[T]`` for all, or for each its own."""
    summed: Tensor = value @ weight if weight.ndim == 1 else (value * weight).sum(-1)
    return summed


class Population(nn.Module):
    """Stacked policies, or reward functions, of one architecture.

    The layers of the members are multiplied together (``baddbmm``; heads as one matrix), which on
    a CPU is as fast as a loop over the members and faster than ``torch.vmap``; on a GPU it is one
    kernel per layer.

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
        self.evolve: Literal["all", "head", "code"]
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
        self._activations = [activation(layer) for layer in list(networks[0])[split:]]
        self.trunk_cache = TrunkCache()

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
        return apply_layers(self.layers(), features)

    def drawn_scores(self, bank: SegmentBank, segment: Tensor, weight: Tensor) -> Tensor:
        """Differentiable scores of each member's own segments, or of segments that all share.

        Args:
            bank: Segments of T steps.
            segment: Segment numbers ``[N, B]``, or ``[B]``, the same for every member.
            weight: What each step counts for, ``[T]``, or like ``segment`` with T behind.

        Returns:
            ``[N, B]``.
        """
        output = self(bank.observation[bank.row[segment]].flatten(-3, -2))
        action = bank.action[segment].flatten(segment.ndim - 1, segment.ndim)
        value = self.spec.step_scores(output, action)
        return added_up(value.view(len(self), segment.shape[-1], -1), weight)

    def layers(self) -> list[Layer]:
        """The members' own layers, stacked: weights ``[N, K, F]`` and biases ``[N, K]``."""
        layers: list[Layer] = []
        for position, between in enumerate(self._activations):
            if between is not None:
                layers.append(between)
                continue
            layer = self.members[str(position)]
            layers.append((layer["weight"], layer.get("bias", None)))
        return layers

    def without_repeats(self) -> tuple["Population", Tensor | None]:
        """Members that are known to differ, and which of these each member is, ``[N]``.

        The population itself and None where there are none that are known to be equal, as among
        whole networks, which nobody compares.
        """
        return self, None

    def constrain_(self) -> None:
        """Put members that a step led out of bounds back, in place; whole networks have none."""

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
        clone._activations, clone.trunk_cache = self._activations, self.trunk_cache
        return clone

    def network(self, index: int) -> nn.Sequential:
        """Member ``index`` as an ordinary network with parameters of its own."""
        network = self._blank_network()
        split = len(self.trunk)
        network[:split].load_state_dict(self.trunk.state_dict())
        own = self.members.data[index].flatten_keys(".").to_dict()
        nn.Sequential(*list(network)[split:]).load_state_dict(own)
        return network

    def plain(self) -> "Population":
        """The same members as whole networks, or as heads on the same trunk: what can be saved."""
        return self

    def _blank_network(self) -> nn.Sequential:
        """A network of the members' architecture, whose weights say nothing yet."""
        generator = torch.Generator().manual_seed(0)
        return build_network(self.spec, generator=generator).to(self.device)
