"""What POPL is compared with: pooled CPL, and CPL that knows the groups (the oracle)."""

from collections.abc import Callable

import torch
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policies import Spec
from popl_rl.models.population import Population
from popl_rl.models.schedules import linear_decay
from popl_rl.models.sets import as_set

__all__ = ["group_weights", "train_cpl"]

_BLOCK = 50  # steps between two changes of the learning rate, and two reports of progress


def group_weights(group: Tensor, num_groups: int) -> Tensor:
    """Weights of a pooled policy and of one oracle per group, ``[1 + G, M]``.

    The oracle reads hidden labels: it is the ceiling for methods that do not.

    Args:
        group: Hidden group of each comparison, ``[M]``.
        num_groups: Number of groups G.

    Raises:
        ValueError: If some group made no comparison.
    """
    oracle = torch.nn.functional.one_hot(group, num_groups).T.float()
    silent = (oracle.sum(1) == 0).nonzero().squeeze(-1).tolist()
    if silent:
        raise ValueError(
            f"groups {silent} have no strict answer, so no oracle can be trained for them; draw "
            "more raters or give those groups a larger share"
        )
    return torch.cat([torch.ones(1, len(group)), oracle])


def train_cpl(
    spec: Spec,
    bank: SegmentBank,
    comparisons: Comparisons,
    weight: Tensor,
    *,
    steps: int = 1500,
    batch_size: int = 256,
    learning_rate: float = 2e-3,
    alpha: float = 0.5,
    conservatism: float = 0.9,
    discount: float = 1.0,
    population: Population | None = None,
    generator: torch.Generator,
    progress: Callable[[int], None] | None = None,
) -> HypothesisSet:
    """Train plain CPL policies (arXiv 2310.13639), several at once.

    Of reward functions, with ``conservatism=1``, this is Bradley–Terry reward learning as in RLHF
    (Christiano et al., 2017).

    Args:
        spec: Sizes of the policies.
        bank: Segments.
        comparisons: M strict preferences.
        weight: How often each policy draws each preference, ``[K, M]``.
        steps: Gradient steps.
        batch_size: Preferences per policy and step.
        learning_rate: Adam's step size.
        alpha: Scale of the scores.
        conservatism: Lambda of the CPL loss.
        discount: Per-step discount of the scores.
        population: K policies to start from, changed in place; fresh networks if None.
        generator: Source of initial weights and batches.
        progress: Called with the number of steps done.

    Returns:
        K policies, in the order of ``weight``.
    """
    if population is None:
        population = Population.create(spec, len(weight), generator=generator).to(weight.device)
    loss = CPLLoss(population, bank, alpha=alpha, conservatism=conservatism, discount=discount)
    optimizer = torch.optim.Adam(population.members.parameters(), lr=learning_rate)
    schedule = linear_decay(optimizer, -(-steps // _BLOCK))
    for done in range(0, steps, _BLOCK):
        descend(
            loss,
            optimizer,
            comparisons,
            steps=min(_BLOCK, steps - done),
            batch_size=batch_size,
            weight=weight,
            generator=generator,
        )
        schedule.step()
        if progress is not None:
            progress(min(done + _BLOCK, steps))
    return as_set(population, alpha=alpha, discount=discount)
