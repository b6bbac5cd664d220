"""From an evolved population to the few policies that people get: which to keep, one last training.

Selection finds out who there is. What it leaves is many members that serve the same raters nearly
alike, each trained on whatever it was selected for last. :func:`smallest_team` keeps as few as
predict the raters as well as more of them do, and :func:`refine` trains each on those whom it
serves: EM (Dempster, Laird and Rubin, 1977) from where evolution has ended, which has also told it
how many there are.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import MISTAKE, leave_one_out, log_likelihood, per_case
from popl_rl.models.scoring import segment_scores

__all__ = [
    "RefinementSettings",
    "predictive",
    "refine",
    "smallest_team",
]

_CUTS = (0.2, 0.4)  # of the steps, after which members that nobody needs are dropped


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of :func:`refine`.

    Attributes:
        steps: Gradient steps.
        block: Steps from one look at who serves whom to the next.
        batch_size: Preferences per step, the same for all members.
        learning_rate: Of Adam; held for half of the steps, then it falls to zero.
        alpha: Scale of the scores. A smaller one makes sharper policies of the same margins.
        conservatism: Lambda of the CPL loss. A smaller one keeps policies nearer to what was
            preferred: they act better, and rank a little worse.
        discount: Per-step discount of the scores.
        mistake: Chance that an answer is a slip, in [0, 0.5).
        folds: Folds of the cross-fitting, at least 2.
        most: Members to begin with, at most.
    """

    steps: int = 1500
    block: int = 50
    batch_size: int = 256
    learning_rate: float = 2e-3
    alpha: float = 0.25
    conservatism: float = 0.8
    discount: float = 1.0
    mistake: float = MISTAKE
    folds: int = 4
    most: int = 8


def predictive(likelihood: Tensor, comparisons: Comparisons) -> Tensor:
    """How well a set that is catered by a case's other answers predicts each of them.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[K, M]``.
        comparisons: The M comparisons and the case of each.

    Returns:
        Mean log-likelihood of each case's answers, ``[C]``.
    """
    count = comparisons.case.bincount(minlength=comparisons.num_cases).clamp(min=1)
    mean: Tensor = per_case(leave_one_out(likelihood, comparisons), comparisons) / count
    return mean


def smallest_team(likelihood: Tensor, comparisons: Comparisons, *, most: int = 8) -> list[int]:
    """As few members as predict the raters as well as more of them do.

    Members are added one after the other, each time the one that helps :func:`predictive` most.
    Of these nested teams the smallest within one standard error of the best is taken (Breiman et
    al., 1984): a further member has to earn its place.

    Args:
        likelihood: Log-likelihood of every comparison under every member, ``[N, M]``.
        comparisons: The M comparisons and the case of each.
        most: Size of the largest team.

    Returns:
        Members, the most useful one first.
    """
    team: list[int] = []
    values = []
    for _ in range(min(most, len(likelihood))):
        rest = [member for member in range(len(likelihood)) if member not in team]
        each = torch.stack([predictive(likelihood[[*team, one]], comparisons) for one in rest])
        best = int(each.mean(1).argmax())
        team.append(rest[best])
        values.append(each[best])
    value = torch.stack(values)
    behind = value[value.mean(1).argmax()] - value
    # A single case has no spread to judge by.
    error = behind.std(1, correction=0) / behind.shape[1] ** 0.5
    good = behind.mean(1) <= error
    return team[: int(good.float().argmax()) + 1]


def refine(
    population: Population,
    bank: SegmentBank,
    comparisons: Comparisons,
    *,
    alpha: float,
    settings: RefinementSettings,
    generator: torch.Generator,
) -> Population:
    """Choose a team of members and train each on the raters whom it serves.

    ``folds + 1`` copies of the team train side by side. Copy f leaves the cases of fold f out and
    tells who serves them; the last copy trains on everything and is the result. Without this every
    member would confirm what it has learnt by heart. The same held-out likelihoods tell, twice
    in the first half, which members nobody needs.

    Args:
        population: N evolved members; copied.
        bank: Segments.
        comparisons: M strict preferences and the case of each.
        alpha: Scale of the scores that the population was evolved with.
        settings: See :class:`RefinementSettings`.
        generator: Source of folds and batches.

    Returns:
        At most ``settings.most`` members.

    Raises:
        ValueError: If ``settings.mistake`` is outside [0, 0.5).
    """
    folds, device = settings.folds, generator.device
    fold = torch.randperm(comparisons.num_cases, generator=generator, device=device) % folds
    case = torch.arange(comparisons.num_cases, device=device)
    row = torch.arange(len(comparisons), device=device)
    use = torch.ones(folds + 1, len(comparisons), device=device)
    use[fold[comparisons.case], row] = 0.0

    def explained(members: Population, scale: float) -> Tensor:
        scores = segment_scores(members, bank, alpha=scale, discount=settings.discount)
        margin = scores[:, comparisons.preferred] - scores[:, comparisons.other]
        return log_likelihood(margin, settings.mistake)

    team = smallest_team(explained(population, alpha), comparisons, most=settings.most)
    copies = population.subset(team * (folds + 1))
    loss, optimizer = _trainer(copies, bank, settings)
    share = torch.full((len(team),), 1 / len(team), device=device)
    blocks = -(-settings.steps // settings.block)
    cuts = [int(cut * blocks) for cut in _CUTS]
    for block in range(blocks):
        likelihood = explained(copies, settings.alpha).unflatten(0, (folds + 1, -1))
        if block in cuts:
            held_out = likelihood[fold[comparisons.case], :, row].T
            kept = sorted(smallest_team(held_out, comparisons))
            likelihood, share = likelihood[:, kept], share[kept]
            index = torch.arange(len(copies), device=device).view(folds + 1, -1)[:, kept]
            copies = copies.subset(index.flatten())
            loss, optimizer = _trainer(copies, bank, settings)
        # The E-step, with the chance of each member as it was before.
        joint = per_case(likelihood, comparisons) + share.clamp(min=1e-3).log().unsqueeze(-1)
        served = joint.softmax(1)[fold, :, case].T
        share = served.mean(1)
        weight = (use.unsqueeze(1) * served[:, comparisons.case]).flatten(0, 1)
        optimizer.param_groups[0]["lr"] = settings.learning_rate * min(1, 2 - 2 * block / blocks)
        for _ in range(min(settings.block, settings.steps - block * settings.block)):
            shape = (settings.batch_size,)
            index = torch.randint(len(comparisons), shape, generator=generator, device=device)
            preferred = comparisons.preferred[index].expand(len(copies), -1)
            other = comparisons.other[index].expand(len(copies), -1)
            better, worse = loss.scores(torch.cat([preferred, other], 1)).chunk(2, dim=1)
            fit = log_likelihood(better - settings.conservatism * worse, settings.mistake)
            optimizer.zero_grad(set_to_none=True)
            (-(fit * weight[:, index]).mean(1).sum()).backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            copies.constrain_()
    return copies.subset(range(len(copies) - len(share), len(copies)))


def _trainer(
    population: Population, bank: SegmentBank, settings: RefinementSettings
) -> tuple[CPLLoss, torch.optim.Adam]:
    loss = CPLLoss(
        population,
        bank,
        alpha=settings.alpha,
        conservatism=settings.conservatism,
        discount=settings.discount,
    )
    return loss, torch.optim.Adam(population.members.parameters(), lr=settings.learning_rate)
