"""What a frozen trunk makes of one bank of segments, kept from one scoring to the next."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from popl_rl.data.bank import SegmentBank

__all__ = ["TrunkCache"]


class TrunkCache:
    """What a frozen trunk makes of one bank, kept from one scoring to the next.

    Shared by a population and its copies. Tensors of a bank are told by identity and version,
    and the trunk by its parameters: a changed one is looked through again.
    """

    def __init__(self) -> None:
        self._bank: tuple[Tensor, ...] = ()
        self._about: tuple[object, ...] = ()
        self._trunk: list[Tensor] = []
        self._value: Tensor | None = None

    def get(
        self,
        trunk: nn.Module,
        bank: SegmentBank,
        purpose: tuple[object, ...],
        make: Callable[[], Tensor],
    ) -> Tensor:
        """The tensor made for this trunk, bank and purpose, made now if it is not there."""
        tensors = (bank.observation, bank.row, bank.action)
        # Tensors made in inference mode keep no version; nor can autograd need them.
        versions = (None if tensor.is_inference() else tensor._version for tensor in tensors)
        about = (*purpose, *versions)
        if (
            self._value is None
            or about != self._about
            or any(one is not two for one, two in zip(tensors, self._bank, strict=True))
            or not all(map(_same, trunk.parameters(), self._trunk))
        ):
            self._value = None  # free it first
            self._value = make()
            self._bank, self._about = tensors, about
            self._trunk = [parameter.detach().clone() for parameter in trunk.parameters()]
        return self._value


def _same(one: Tensor, two: Tensor) -> bool:
    return one.device == two.device and one.dtype == two.dtype and torch.equal(one, two)
