"""Down-sampling: select on some of the cases, drawn at random or so that rare cases stay in.

Scoring every member on every case is what a generation costs, so fewer cases buy more generations
or members (Helmuth and Spector, "Problem-solving benefits of down-sampled lexicase selection",
2021). Draw the cases once per generation, score the members on those only, and select as usual:

    cases = downsample(num_cases, num_cases // 10, generator=generator)
    parents = lexicase_selection(score(members, cases), num_children, generator=generator)

To let each selection see a sample of its own instead, use ``cases_per_selection`` of
`popl_rl.selection.lexicase.lexicase_selection`; that saves no scoring.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from popl_rl.selection.arguments import check_count, check_generator, check_scores
from popl_rl.selection.farthest_first import farthest_first

__all__ = ["downsample", "informed_downsample", "spread_out"]


def downsample(num_cases: int, num_kept: int, *, generator: torch.Generator) -> Tensor:
    """Draw cases at random, every subset of this size equally likely.

    Args:
        num_cases: Number of cases there are.
        num_kept: Number of cases to draw, at most ``num_cases``.
        generator: Source of randomness; the result is on its device.

    Returns:
        Distinct case indices in random order, ``[num_kept]``, int64.

    Raises:
        TypeError: A count is not an int, or ``generator`` no generator.
        ValueError: A count is out of range.
    """
    check_count("num_cases", num_cases, None)
    check_count("num_kept", num_kept, num_cases)
    check_generator(generator)
    return torch.randperm(num_cases, generator=generator, device=generator.device)[:num_kept]


def informed_downsample(
    passes: Tensor, num_kept: int, *, num_members: int = 64, generator: torch.Generator
) -> Tensor:
    """Draw cases that members pass and fail differently, so that rare ones stay in.

    A case's solve vector says which of a random sample of members pass it. Farthest-first traversal
    keeps a random case first and then, again and again, a case whose solve vector is farthest (in
    Hamming distance) from that of the nearest case kept, ties broken at random. Cases that many
    others duplicate are kept once before any is kept twice; a case that only a few specialists
    pass, or fail, stands apart and is kept early (informed down-sampling: Boldi et al., 2024,
    doi 10.1162/evco_a_00346).

    Memory grows with cases times sampled members, never with cases squared.

    Args:
        passes: Who passes what, ``[member, case]``, bool. Threshold real scores first.
        num_kept: Number of cases to draw, at most the number of cases.
        num_members: Members in the sample. All members if there are no more than that.
        generator: Source of randomness, on the device of ``passes``.

    Returns:
        Distinct case indices in the order in which they were kept, ``[num_kept]``, int64: the first
        k of them are an informed sample of k cases.

    Raises:
        TypeError: ``passes`` is no bool tensor, a count is not an int, or ``generator`` no
            generator.
        ValueError: ``passes`` is not a matrix or is empty, a count is out of range, or
            ``generator`` is on another device.
    """
    check_scores(passes, "passes")
    if passes.dtype != torch.bool:
        raise TypeError(
            f"passes must be bool, got {passes.dtype}; say what counts as a pass, for example "
            "scores > 0"
        )
    num_cases = passes.shape[1]
    check_count("num_kept", num_kept, num_cases)
    check_count("num_members", num_members, None)
    check_generator(generator, passes.device, "passes")

    sample = torch.randperm(len(passes), generator=generator, device=passes.device)[:num_members]
    # With solve vectors of -1 and 1, [case, member], distance falls as the dot product grows.
    vectors = (2.0 * passes[sample].T - 1.0).contiguous()
    return farthest_first(
        lambda some, others: vectors[some] @ vectors[others].T,
        num_cases,
        num_kept,
        generator=generator,
        device=passes.device,
    )


def spread_out(
    similarity: Callable[[Tensor], Tensor],
    num_raters: int,
    count: int,
    *,
    generator: torch.Generator,
) -> Tensor:
    """Choose raters unlike each other: farthest first, from a random one.

    As informed down-sampling does with cases (Boldi et al., 2024), it keeps what is rare in sight.

    Args:
        similarity: Correlations of some raters with all, ``[R] -> [R, rater]``.
        num_raters: Number of raters.
        count: Raters to choose, at least 1; more than there are repeat.
        generator: Source of the first one.

    Returns:
        Indices of raters in the order in which they were chosen, ``[count]``, int64.
    """
    start = int(torch.randint(num_raters, (), generator=generator, device=generator.device))
    return farthest_first(
        lambda some, others: similarity(others)[:, some].T,
        num_raters,
        count,
        first=start,
        repeat=True,
        device=generator.device,
    )
