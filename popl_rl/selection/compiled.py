"""Where compiled kernels are used: on passes in the processor's memory, if numba is installed.

A small population takes hundreds of calls of torch, whatever it holds; the kernels take the place
of most, and read a large one fewer times. Parents are the same with numba and without.
"""

from functools import lru_cache
from importlib.util import find_spec
from types import ModuleType

import torch
from torch import Tensor

__all__ = ["find_kernels", "kernels_for"]


def kernels_for(scores: Tensor) -> ModuleType | None:
    """The module `popl_rl.selection.kernels`, or None if torch has to do the work.

    Args:
        scores: What is worked on. Real scores are left to torch.
    """
    passes = scores.dtype in (torch.bool, torch.uint8)
    return find_kernels() if passes and scores.device.type == "cpu" else None


@lru_cache
def find_kernels() -> ModuleType | None:
    """The kernels, or None if numba is not installed."""
    if find_spec("numba") is None:
        return None
    from popl_rl.selection import kernels  # a moment to load, which only passes need

    return kernels
