"""A population whose members are style codes of one frozen network."""

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn

from popl_rl.data.bank import SegmentBank
from popl_rl.models.layers import Layer, activation
from popl_rl.models.population import Population
from popl_rl.models.style_codes import StyleClone
from popl_rl.models.style_scores import ShiftedNetwork, shifted_scores

__all__ = ["StyledPopulation"]


class StyledPopulation(Population):
    """Members of a few numbers each, told to a frozen network.

    See ``popl_rl.models.style_codes.StyleClone`` for the network.

    For a fixed code the clone is an ordinary policy network: what the code adds to the first layer
    is a bias. All other weights are shared, so scoring multiplies large matrices and a member is
    stored, varied and swapped at the cost of its code.

    Args:
        clone: What the codes are told to.
        codes: The members, ``[N, D]``.

    Attributes:
        members: A ``TensorDictParams`` of batch size ``[N]`` with ``code``.

    Raises:
        ValueError: If there are no codes, or they are not of the clone's length.
    """

    def __init__(self, clone: StyleClone, codes: Tensor) -> None:
        nn.Module.__init__(self)
        expected = clone.codes.shape[1]
        if codes.ndim != 2 or not len(codes) or codes.shape[1] != expected:
            raise ValueError(
                f"codes must have shape [members, {expected}] with at least one member, got "
                f"{list(codes.shape)}"
            )
        self.spec = clone.spec
        self.evolve = "code"
        self.trunk = nn.Sequential()
        self.clone = clone
        self.members = TensorDictParams(TensorDict({"code": codes.clone()}, [len(codes)]))

    @classmethod
    def of_data(
        cls, clone: StyleClone, count: int, *, generator: torch.Generator
    ) -> "StyledPopulation":
        """Members that fill the continuous code as the data do: a set over it to ask and cater by.

        Weighing such members by answers is importance sampling of the belief over the code, with
        the data's codes as the prior.

        Args:
            clone: What the codes are told to.
            count: Members.
            generator: Source of the codes.
        """
        return cls(clone, clone.draw(count, generator=generator))

    def layers(self) -> list[Layer]:
        """The clone's layers, shared by all members but for the first bias, ``[N, H]``."""
        layers: list[Layer] = [(self.clone.first_layer()[0], self._first_bias())]
        for layer in list(self.clone.network)[1:]:
            if isinstance(layer, nn.Linear):
                layers.append((layer.weight, layer.bias))
            else:
                layers.append(activation(layer) or layer)
        return layers

    def without_repeats(self) -> tuple[Population, Tensor | None]:
        """Members of different codes; many end in the same corner of the box that codes are in."""
        codes, place = self.members.data["code"].unique(dim=0, return_inverse=True)
        if len(codes) == len(self):
            return self, None
        return StyledPopulation(self.clone, codes), place

    def drawn_scores(self, bank: SegmentBank, segment: Tensor, weight: Tensor) -> Tensor:
        """See ``popl_rl.models.population.Population``."""
        # Blocks are so small for a processor's cache; a GPU would wait for each of them.
        if not torch.is_grad_enabled() or self.device.type != "cpu":
            return super().drawn_scores(bank, segment, weight)
        later = [
            (layer.weight, layer.bias)
            for layer in list(self.clone.network)[1:]
            if isinstance(layer, nn.Linear)
        ]
        network = ShiftedNetwork(self.clone.spec, self.clone.first_layer()[0], later)
        return shifted_scores(self._first_bias(), network, bank, segment, weight)

    def _first_bias(self) -> Tensor:
        """What the first layer adds for each member, ``[N, H]``."""
        _, told, bias = self.clone.first_layer()
        shift: Tensor = bias + self.members["code"] @ told.T
        return shift

    @torch.no_grad()
    def constrain_(self) -> None:
        """Put codes back into the box that most of the data's codes lie in."""
        code = self.members.data["code"]
        code.copy_(code.clamp(self.clone.low, self.clone.high))

    def with_members(self, members: TensorDictBase) -> "StyledPopulation":
        """See ``popl_rl.models.population.Population``."""
        return StyledPopulation(self.clone, members["code"])

    def network(self, index: int) -> nn.Sequential:
        """Member ``index`` as an ordinary network with parameters of its own."""
        network = self._blank_network()
        seen, told, bias = self.clone.first_layer()
        own = {name: value.clone() for name, value in self.clone.network.state_dict().items()}
        own["0.weight"] = seen.clone()
        own["0.bias"] = bias + told @ self.members.data["code"][index]
        network.load_state_dict(own)
        return network

    def plain(self) -> Population:
        """The same policies as whole networks."""
        return Population([self.network(index) for index in range(len(self))], self.spec)
