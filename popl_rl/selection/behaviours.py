"""Members that score alike on every case: one behaviour."""

import torch
from torch import Tensor

__all__ = ["fingerprints", "label_behaviours"]


def label_behaviours(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Number the distinct rows of scores ``[member, case]``.

    Returns:
        Label of each member, ``[member]``, and the first member with each label, ``[label]``.
    """
    num_members, num_cases = scores.shape
    everyone = torch.arange(num_members, device=scores.device)
    for width in (256, num_cases):  # a few cases mostly suffice to tell everybody apart
        labels: Tensor = torch.unique(fingerprints(scores[:, :width]), return_inverse=True)[1]
        if int(labels.max()) + 1 == num_members:
            return everyone, everyone
        if width >= num_cases:
            break
    first = _first_with(labels)
    twins = (first[labels] != everyone).nonzero().view(-1)
    for some in torch.split(twins, _rows_at_once(scores)):
        if not torch.equal(scores[some], scores[first[labels[some]]]):  # fingerprints have clashed
            labels = torch.unique(scores, dim=0, return_inverse=True)[1]
            return labels, _first_with(labels)
    return labels, first


def _first_with(labels: Tensor) -> Tensor:
    """First member with each label."""
    everyone = torch.arange(len(labels), device=labels.device)
    return everyone.new_zeros(int(labels.max()) + 1).scatter_reduce(
        0, labels, everyone, "amin", include_self=False
    )


def fingerprints(scores: Tensor) -> Tensor:
    """Hash each row to 64 bits, ``[member]``: a random linear function of its 8-byte words."""
    generator = torch.Generator().manual_seed(0)  # the result must not depend on the caller's
    num_bytes = scores.shape[1] * scores.element_size()
    shape = (-(-num_bytes // 8),)
    factors = torch.randint(-(2**63), 2**63 - 1, shape, generator=generator).to(scores.device)
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


def _rows_at_once(scores: Tensor) -> int:
    """Rows that fit into a processor's cache together, at least one."""
    return max(1, 2**19 // (scores.shape[1] * scores.element_size()))
