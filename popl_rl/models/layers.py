"""Layers of stacked members: applied, cast, and taken apart."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor, nn

__all__ = [
    "Layer",
    "activation",
    "apply_layers",
    "apply_shared",
    "change_layers",
    "some_layers",
]


#: Weight and bias of a linear layer, or what comes between two of them. Weights are ``[N, K, F]``,
#: or ``[K, F]`` where all members share one; biases ``[N, K]``, or ``[K]`` likewise. Without a
#: weight the bias is added to what is there.
Layer = tuple[Tensor | None, Tensor | None] | nn.Module


def activation(layer: nn.Module) -> nn.Module | None:
    """A layer's activation, or None for a linear layer."""
    if isinstance(layer, nn.Linear):
        return None
    # It follows a linear layer, whose output nobody else needs.
    return nn.ReLU(inplace=True) if isinstance(layer, nn.ReLU) else layer


def apply_layers(layers: Sequence[Layer], features: Tensor) -> Tensor:
    """Own layers of N members on features ``[R, F]`` or ``[N, R, F]``, ``[N, R, K]``."""
    hidden, shape = features, torch.Size()
    for layer in layers:
        if isinstance(layer, nn.Module):
            hidden = layer(hidden)
            continue
        weight, bias = layer
        if shape and (weight is None or weight.ndim > 2):
            hidden, shape = hidden.view(*shape, -1), torch.Size()
        if weight is None:
            hidden = hidden if bias is None else hidden + bias.unsqueeze(-2)
            continue
        if weight.ndim == 2:
            if bias is None or bias.ndim == 1:
                # As one matrix until the end: autograd copies what is changed in place, as by ReLU,
                # if it is a view, such as a matrix in another shape.
                shape = hidden.shape[:-1] if hidden.ndim > 2 else shape
                hidden = F.linear(hidden.flatten(0, -2), weight, bias)
            else:
                hidden = F.linear(hidden, weight) + bias.unsqueeze(1)
            continue
        count = len(weight)
        if hidden.ndim == 2 and len(layers) == 1:
            # Heads on features they share: one product with all of them below each other.
            stack = weight.flatten(0, 1)
            if bias is None:
                product = stack @ hidden.T
            else:
                product = torch.addmm(bias.flatten().unsqueeze(1), stack, hidden.T)
            return product.view(count, -1, len(hidden)).mT
        if hidden.ndim == 2:
            hidden = hidden.expand(count, *hidden.shape)
        if bias is None:
            hidden = torch.bmm(hidden, weight.mT)
        else:
            hidden = torch.baddbmm(bias.unsqueeze(1), hidden, weight.mT)
    return hidden.view(*shape, -1) if shape else hidden


def apply_shared(layers: Sequence[Layer], features: Tensor) -> tuple[list[Layer], Tensor]:
    """Do once for all members what they share of the first layer.

    Args:
        layers: Own layers of N members.
        features: What these are applied to, ``[R, F]``.

    Returns:
        What is left to do, and what to do it to: the layers and features themselves where the first
        layer is not shared.
    """
    first = layers[0]
    if isinstance(first, nn.Module) or first[0] is None or first[0].ndim != 2:
        return list(layers), features
    return [(None, first[1]), *layers[1:]], F.linear(features, first[0])


def change_layers(layers: Sequence[Layer], change: Callable[[Tensor], Tensor]) -> list[Layer]:
    """The same layers with other weights and biases."""
    changed: list[Layer] = []
    for layer in layers:
        if isinstance(layer, nn.Module):
            changed.append(layer)
        else:
            weight, bias = layer
            changed.append(
                (
                    None if weight is None else change(weight),
                    None if bias is None else change(bias),
                )
            )
    return changed


def some_layers(layers: Sequence[Layer], part: slice) -> list[Layer]:
    """The layers of some members; what all members share stays as it is."""
    chosen: list[Layer] = []
    for layer in layers:
        if isinstance(layer, nn.Module):
            chosen.append(layer)
        else:
            weight, bias = layer
            own = weight[part] if weight is not None and weight.ndim == 3 else weight
            chosen.append((own, bias[part] if bias is not None and bias.ndim == 2 else bias))
    return chosen
