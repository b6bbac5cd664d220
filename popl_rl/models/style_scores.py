"""Scores by which style codes learn: a frozen network and how its scores change, block by block.

Members differ in a bias of the first layer alone, so that a score and its gradient by that bias are
found together, for as many steps at a time as stay in a processor's cache. Going through the
network with all steps of all members, and then back, takes a third longer on a processor: it moves
every layer's output to memory and back.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor
from torch.autograd.function import once_differentiable

from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import added_up

__all__ = ["ShiftedNetwork", "shifted_scores"]

_ROWS = 1024  # steps looked at together


class ShiftedNetwork(NamedTuple):
    """A frozen network of linear layers with ReLU between them, whose first bias members give.

    Attributes:
        spec: Kind of policy.
        first: Weight of the first layer, ``[H, O]``.
        later: Weight ``[K, F]`` and bias ``[K]`` of each layer behind it.
    """

    spec: PolicySpec
    first: Tensor
    later: Sequence[tuple[Tensor, Tensor]]


def shifted_scores(
    shift: Tensor, network: ShiftedNetwork, bank: SegmentBank, segment: Tensor, weight: Tensor
) -> Tensor:
    """Scores of segments, of which gradients by the members' first biases can be taken once.

    Args:
        shift: First bias of N members, ``[N, H]``.
        network: The rest of it.
        bank: Segments of T steps.
        segment: Segment numbers ``[N, B]``, or ``[B]``, the same for every member.
        weight: What each step counts for, ``[T]``, or like ``segment`` with T behind.

    Returns:
        ``[N, B]``.
    """
    scores: Tensor = _Scores.apply(shift, network, bank, segment, weight)  # type: ignore[no-untyped-call]
    return scores


class _Scores(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        shift: Tensor,
        network: ShiftedNetwork,
        bank: SegmentBank,
        segment: Tensor,
        weight: Tensor,
    ) -> Tensor:
        scores = shift.new_empty(len(shift), segment.shape[-1])
        slopes = shift.new_empty(*scores.shape, shift.shape[1])
        size = max(1, _ROWS // bank.row.shape[1])
        # Rows of segments, one for each member or one for all of them.
        rows = segment if segment.ndim == 2 else segment.unsqueeze(0)
        each = len(shift) // len(rows)
        for row, own in enumerate(rows):
            for start in range(0, len(own), size):
                part = slice(start, start + size)
                counts = weight if weight.ndim == 1 else weight.view(*rows.shape, -1)[row, part]
                block = _Block(network, bank, own[part], counts)
                for member in range(row * each, (row + 1) * each):
                    scores[member, part], slopes[member, part] = block.look(shift[member])
        ctx.save_for_backward(slopes)
        return scores

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return torch.bmm(gradient.unsqueeze(1), slopes).squeeze(1), None, None, None, None


class _Block:
    """A few segments, and what the first layer makes of them before its bias."""

    def __init__(
        self, network: ShiftedNetwork, bank: SegmentBank, segment: Tensor, weight: Tensor
    ) -> None:
        self.network, self.weight = network, weight
        self.steps = bank.row.shape[1]
        seen = bank.observation.index_select(0, bank.row[segment].flatten())
        self.first = F.linear(seen, network.first)
        self.action = bank.action[segment].flatten(0, 1)

    def look(self, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Scores ``[B]``, and their gradients by the first bias ``[B, H]``."""
        hidden = self.first + shift
        outputs = []
        for weight, bias in self.network.later:
            outputs.append(hidden.relu_())
            hidden = torch.addmm(bias, hidden, weight.T)
        with torch.enable_grad():
            hidden.requires_grad_()
            value = self.network.spec.step_scores(hidden, self.action).view(-1, self.steps)
            scores = added_up(value, self.weight)
            (slope,) = torch.autograd.grad(scores.sum(), hidden)
        for weight, _ in reversed(self.network.later):
            passed = outputs.pop().sign_()  # 1 where ReLU let pass, else 0
            slope = (slope @ weight).mul_(passed)
        return scores.detach(), slope.view(-1, self.steps, slope.shape[1]).sum(1)
