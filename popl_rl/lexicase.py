"""Lexicase selection: parents that are best on some random order of the cases."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

__all__ = ["SelectionReport", "lexicase_report", "lexicase_selection"]


@dataclass(frozen=True)
class SelectionReport:
    """What a round of lexicase selection did."""

    parents: Tensor
    depth: Tensor
    distinct: int
    effective: float


def lexicase_selection(
    scores: Tensor,
    num_selected: int,
    *,
    epsilon: float | Tensor | Literal["mad"] | None = None,
    epsilon_mode: Literal["static", "semi-dynamic"] = "semi-dynamic",
    cases_per_selection: int | None = None,
    generator: torch.Generator,
) -> Tensor:
    """Select parents by lexicase selection; see :func:`lexicase_report` for the arguments."""
    return lexicase_report(
        scores,
        num_selected,
        epsilon=epsilon,
        epsilon_mode=epsilon_mode,
        cases_per_selection=cases_per_selection,
        generator=generator,
    ).parents


def lexicase_report(
    scores: Tensor,
    num_selected: int,
    *,
    epsilon: float | Tensor | Literal["mad"] | None = None,
    epsilon_mode: Literal["static", "semi-dynamic"] = "semi-dynamic",
    cases_per_selection: int | None = None,
    generator: torch.Generator,
) -> SelectionReport:
    """Select parents by lexicase selection and report how the selection went."""
    if scores.ndim != 2 or 0 in scores.shape:
        raise ValueError(f"scores must be a non-empty [member, case] matrix, got {scores.shape}")
    if num_selected < 1:
        raise ValueError(f"num_selected must be at least 1, got {num_selected}")
    values = scores.double()
    num_cases = values.shape[1]
    if epsilon == "mad":
        middle = values.quantile(0.5, dim=0)
        slack = (values - middle).abs().quantile(0.5, dim=0)
    else:
        slack = torch.as_tensor(0.0 if epsilon is None else epsilon, device=values.device)
        slack = slack.to(values.dtype).expand(num_cases)
    if epsilon is not None and epsilon_mode == "static":
        values = (values >= values.amax(0) - slack).double()
        slack = torch.zeros_like(slack)
    behaviours, inverse = values.unique(dim=0, return_inverse=True)
    parents, depth = [], []
    for _ in range(num_selected):
        order = torch.randperm(num_cases, generator=generator, device=values.device)
        pool = torch.arange(len(behaviours), device=values.device)
        looked = 0
        for position, case in enumerate(order[:cases_per_selection].tolist()):
            if len(pool) == 1:
                break
            column = behaviours[pool, case]
            kept = pool[column >= column.max() - slack[case]]
            if len(kept) < len(pool):
                pool, looked = kept, position + 1
        members = torch.isin(inverse, pool).nonzero().squeeze(1)
        pick = torch.randint(len(members), (), generator=generator, device=values.device)
        parents.append(members[pick])
        depth.append(looked)
    chosen = torch.stack(parents)
    share = inverse[chosen].bincount().double() / num_selected
    return SelectionReport(
        chosen,
        torch.tensor(depth, device=values.device),
        len(behaviours),
        float(1 / share.square().sum()),
    )
