"""What a rater's function may return: one finite number for each step."""

from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["checked"]


def checked(result: object, segments: TensorDictBase, *, rater: str) -> Tensor:
    """What a rater's function returned, as float32 ``[B, T]``.

    Args:
        result: What it returned.
        segments: What it was shown, TensorDict of batch size ``[B, T]``.
        rater: Name of the rater, for messages.

    Raises:
        TypeError: If it is no floating-point tensor.
        ValueError: If it has another shape, or is not finite in float32.
    """
    if not isinstance(result, Tensor):
        raise TypeError(
            f"rater {rater!r} must return a float tensor of shape {list(segments.batch_size)}, got "
            f"a {type(result).__name__}."
        )
    if result.shape != segments.batch_size:
        raise ValueError(
            f"rater {rater!r} must return one utility per step, shape "
            f"{list(segments.batch_size)}, got shape {list(result.shape)}"
            f"{_shape_cure(result, segments)}."
        )
    if not result.is_floating_point():
        raise TypeError(
            f"rater {rater!r} must return floats, got {result.dtype}; call .float() on it."
        )
    # Checked afterwards: float64 holds numbers that float32 does not.
    result = result.float()
    if not bool(result.isfinite().all()):
        raise ValueError(
            f"rater {rater!r} must return finite numbers, got {int((~result.isfinite()).sum())} "
            f"NaN or infinite of {result.numel()}, as float32."
        )
    return result


def _shape_cure(result: Tensor, segments: TensorDictBase) -> str:
    if result.ndim > 2 and result.shape[:2] == segments.batch_size:
        return "; reduce the last dimension, as in .sum(-1)"
    if result.shape == segments.batch_size[:1]:
        return "; give each step its utility instead of one number per segment"
    return ""
