"""Down-sampling: select on a part of the cases, drawn at random or so that rare cases stay in."""

import torch
from torch import Tensor

__all__ = ["downsample", "informed_downsample"]


def downsample(num_cases: int, num_kept: int, *, generator: torch.Generator) -> Tensor:
    """Draw ``num_kept`` of ``num_cases`` cases, each subset equally likely."""
    order = torch.randperm(num_cases, generator=generator, device=generator.device)
    return order[:num_kept].sort().values


def informed_downsample(
    solved: Tensor, num_kept: int, *, num_members: int = 64, generator: torch.Generator
) -> Tensor:
    """Draw cases that the members solve differently, by farthest-first traversal."""
    members = torch.randperm(len(solved), generator=generator, device=solved.device)[:num_members]
    vectors = solved[members].T.float()
    first = torch.randint(len(vectors), (), generator=generator, device=solved.device)
    kept = [int(first)]
    distance = torch.full((len(vectors),), torch.inf, device=solved.device)
    while len(kept) < num_kept:
        distance = torch.minimum(distance, (vectors != vectors[kept[-1]]).sum(1))
        distance[kept[-1]] = -1
        ties = (distance == distance.max()).nonzero().squeeze(1)
        pick = torch.randint(len(ties), (), generator=generator, device=solved.device)
        kept.append(int(ties[pick]))
    return torch.tensor(kept, device=solved.device).sort().values
