"""Convolutions as linear layers over patches, which stacked members multiply as any others."""

from collections.abc import Sequence

import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor, nn

__all__ = ["Joined", "Patches", "image_layers", "is_channels_first"]

_SMALL = 16  # pixels along a side from which on a convolution halves it


def is_channels_first(shape: Sequence[int]) -> bool:
    """Whether an image of this shape is ``[C, H, W]``: its first number is the smaller one."""
    return shape[0] < shape[2]


class Patches(nn.Module):
    """Cuts images into patches: a linear layer on each of these is a convolution.

    Args:
        channels: Channels C of an image.
        side: Height and width of it.
        kernel: Pixels along a side of a patch.
        stride: Pixels from one patch to the next.
        scale: What pixels are divided by.
        channels_first: Whether numbers come as ``[C, H, W]`` rather than ``[H, W, C]``.

    Attributes:
        size: Patches along height and width.
        count: Patches P of an image.
        features: Numbers of a patch, ``C * kernel * kernel``.
    """

    def __init__(
        self,
        channels: int,
        side: tuple[int, int],
        *,
        kernel: int,
        stride: int,
        scale: float = 1.0,
        channels_first: bool = False,
    ) -> None:
        super().__init__()
        self.channels, self.side, self.kernel, self.stride = channels, side, kernel, stride
        self.scale, self.channels_first = scale, channels_first
        self.size = tuple((length - kernel) // stride + 1 for length in side)
        self.count = self.size[0] * self.size[1]
        self.features = channels * kernel * kernel

    def extra_repr(self) -> str:
        """Its sizes, by which networks of different ones are told apart."""
        return f"{self.channels}, {self.side}, kernel={self.kernel}, stride={self.stride}"

    def forward(self, image: Tensor) -> Tensor:
        """Cut ``[..., R, H * W * C]`` into ``[..., R * P, C * kernel * kernel]``."""
        flat = image.flatten(0, -2) / self.scale
        if self.channels_first:
            pixels = flat.unflatten(-1, (self.channels, *self.side))
        else:
            pixels = flat.unflatten(-1, (*self.side, self.channels)).movedim(-1, 1)
        patches = F.unfold(pixels, self.kernel, stride=self.stride).mT
        return patches.reshape(*image.shape[:-2], -1, self.features)


class Joined(nn.Module):
    """Puts the patches of each image together again, as ``[H, W, C]``.

    Args:
        count: Patches P of an image.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def forward(self, patches: Tensor) -> Tensor:
        """Join ``[..., R * P, C]`` to ``[..., R, P * C]``."""
        return patches.reshape(*patches.shape[:-2], -1, self.count * patches.shape[-1])


def image_layers(
    shape: Sequence[int], channels: Sequence[int], *, scale: float = 1.0
) -> tuple[list[nn.Module], int]:
    """Layers of a small convolutional network, ``[..., R, pixels] -> [..., R, features]``.

    Kernels are 3 pixels wide; of an image wider than 16 they are 4 and halve it.

    Args:
        shape: Of an image, ``[H, W, C]``, or ``[C, H, W]`` where the first number is smaller than
            the last.
        channels: Outputs of each convolution.
        scale: What pixels are divided by.

    Returns:
        The layers, whose weights are drawn from torch's own generator, and the number of features.

    Raises:
        ValueError: If the image is too small for so many convolutions.
    """
    first = is_channels_first(shape)
    depth, *side = shape if first else (shape[2], shape[0], shape[1])
    layers: list[nn.Module] = []
    for outputs in channels:
        kernel, stride = (4, 2) if min(side) > _SMALL else (3, 1)
        if min(side) < kernel:
            raise ValueError(
                f"images of shape {list(shape)} are too small for {len(channels)} convolutions; "
                "give fewer in method.channels, or none"
            )
        patches = Patches(
            depth,
            (side[0], side[1]),
            kernel=kernel,
            stride=stride,
            scale=1.0 if layers else scale,
            channels_first=first and not layers,
        )
        convolution = nn.Linear(patches.features, outputs)
        layers += [patches, convolution, nn.ReLU(), Joined(patches.count)]
        depth, side = outputs, list(patches.size)
    return layers, depth * side[0] * side[1]
