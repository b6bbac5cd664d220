"""Named random streams: an independent source of randomness for each purpose of a run."""

import zlib

import torch

__all__ = ["stream"]


def stream(seed: int, name: str, device: torch.device | str = "cpu") -> torch.Generator:
    """An independent source of randomness for one purpose of a run.

    Each purpose has its own, so that asking for more of one thing changes nothing else.

    Args:
        seed: Seed of the run.
        name: The purpose. Part of the results: another name gives other numbers.
        device: Where the generator draws.

    Returns:
        A generator, in the same state for the same seed and name.
    """
    return torch.Generator(device).manual_seed(zlib.crc32(f"{seed}/{name}".encode()))
