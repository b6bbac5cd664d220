"""Checks of arguments that all rules of selection share."""

import torch
from torch import Tensor

__all__ = ["DTYPES", "check_count", "check_generator", "check_scores"]


def check_scores(scores: Tensor, name: str = "scores") -> None:
    """Check that scores are a matrix ``[member, case]`` of comparable numbers.

    Raises:
        TypeError: If they are no tensor, or of a dtype without an order.
        ValueError: If they are not a matrix, are empty or contain NaN.
    """
    if not isinstance(scores, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(scores).__name__}")
    if scores.dtype not in DTYPES:
        raise TypeError(f"{name} must be bool, integer or floating, got {scores.dtype}")
    if scores.ndim != 2:
        raise ValueError(
            f"{name} must be a [member, case] matrix, got shape {tuple(scores.shape)}; for a "
            f"single case use {name}[:, None]"
        )
    if 0 in scores.shape:
        raise ValueError(
            f"{name} must have at least one member and one case, got shape {tuple(scores.shape)}"
        )
    if scores.dtype.is_floating_point and bool(scores.aminmax().min.isnan()):
        raise ValueError(
            f"{name} must not contain NaN, got {int(scores.isnan().sum())} of them; replace them, "
            "by -inf to rank them last"
        )


def check_count(name: str, count: int, most: int | None) -> None:
    """Check that a number of cases or parents is from 1 to ``most``, the number of cases.

    Raises:
        TypeError: If it is no int.
        ValueError: If it is out of range.
    """
    if isinstance(count, bool) or not isinstance(count, int):
        raise TypeError(f"{name} must be an int, got {type(count).__name__}")
    if count < 1 or (most is not None and count > most):
        bounds = "at least 1" if most is None else f"from 1 to {most}, the number of cases"
        raise ValueError(f"{name} must be {bounds}, got {count}")


def check_generator(
    generator: torch.Generator, device: torch.device | None = None, name: str = "scores"
) -> None:
    """Check that a generator is one, and on the device of the tensor called ``name``.

    Raises:
        TypeError: If it is no generator.
        ValueError: If it is on another device.
    """
    if not isinstance(generator, torch.Generator):
        raise TypeError(
            f"generator must be a torch.Generator, got {type(generator).__name__}; make one with "
            "torch.Generator(device).manual_seed(seed)"
        )
    if device is not None and generator.device.type != device.type:
        raise ValueError(
            f"generator must be on the device of {name}, {device}, got {generator.device}; make it "
            f"with torch.Generator({str(device)!r})"
        )


#: Dtypes of scores: all whose values can be compared.
DTYPES = (
    torch.bool,
    *(torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
)
