"""Members that score alike on every case: one behaviour."""

from functools import lru_cache

import torch
from torch import Tensor

from popl_rl.selection.compiled import kernels_for

__all__ = ["fingerprints", "label_behaviours"]


def label_behaviours(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Number the distinct rows of scores ``[member, case]``.

    Returns:
        Label of each member, ``[member]``, and the first member with each label, ``[label]``.
    """
    num_members, num_cases = scores.shape
    everyone = torch.arange(num_members, device=scores.device)
    for width in (256, num_cases):  # a few cases mostly suffice to tell everybody apart
        prints = fingerprints(scores[:, :width])
        ordered = prints.sort().values
        if bool((ordered[1:] != ordered[:-1]).all()):
            return everyone, everyone
        if width >= num_cases:
            break
    labels: Tensor = torch.unique(prints, return_inverse=True)[1]
    first = _first_with(labels)
    twins = (first[labels] != everyone).nonzero().view(-1)
    if not _same_rows(scores, twins, first[labels[twins]]):  # fingerprints have clashed
        labels = torch.unique(scores, dim=0, return_inverse=True)[1]
        return labels, _first_with(labels)
    return labels, first


def _same_rows(scores: Tensor, some: Tensor, others: Tensor) -> bool:
    """Whether each of some rows equals the other one of its place."""
    kernels = kernels_for(scores)
    if kernels is not None:
        flags = scores.view(torch.uint8).numpy()
        return bool(kernels.same_rows(flags, some.numpy(), others.numpy()))
    rows = _rows_at_once(scores)
    parts = zip(torch.split(some, rows), torch.split(others, rows), strict=True)
    return all(torch.equal(scores[part], scores[other]) for part, other in parts)


def _first_with(labels: Tensor) -> Tensor:
    """First member with each label."""
    everyone = torch.arange(len(labels), device=labels.device)
    return everyone.new_zeros(int(labels.max()) + 1).scatter_reduce(
        0, labels, everyone, "amin", include_self=False
    )


def fingerprints(scores: Tensor) -> Tensor:
    """Hash each row to 64 bits, ``[member]``: a random linear function of its 8-byte words."""
    num_bytes = scores.shape[1] * scores.element_size()
    factors = _factors(-(-num_bytes // 8), scores.device)
    kernels = kernels_for(scores)
    if kernels is not None and _is_whole_words(scores):
        hashed = kernels.fingerprints(scores.view(torch.int64).numpy(), factors.numpy())
        return torch.from_numpy(hashed)
    prints = []
    for part in torch.split(scores, _rows_at_once(scores)):
        if part.dtype.is_floating_point:
            part = part + 0.0  # -0.0 equals 0.0 but has other bits
        # Flattened first: the stride of a single row is arbitrary, and views of other types mind.
        words = part.flatten().view(torch.uint8).view(len(part), -1)
        if num_bytes % 8:
            words = torch.nn.functional.pad(words, (0, -num_bytes % 8))
        words = words.view(torch.int64)
        # A product keeps the low bits of a word apart, not the high ones: fold those in first.
        prints.append(((words ^ ((words >> 32) & 0xFFFFFFFF)) * factors).sum(1))
    return torch.cat(prints)


def _is_whole_words(passes: Tensor) -> bool:
    """Whether each row is a sequence of aligned 8-byte words, as it lies in memory."""
    starts = (passes.shape[1], passes.stride(0), passes.storage_offset(), passes.data_ptr())
    return passes.stride(1) == 1 and not any(start % 8 for start in starts)


@lru_cache(maxsize=4)
def _factors(count: int, device: torch.device) -> Tensor:
    """Random factors, always the same: the result must not depend on the caller's generator."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(-(2**63), 2**63 - 1, (count,), generator=generator).to(device)


def _rows_at_once(scores: Tensor) -> int:
    """Rows that fit into a processor's cache together, at least one."""
    return max(1, 2**19 // (scores.shape[1] * scores.element_size()))
