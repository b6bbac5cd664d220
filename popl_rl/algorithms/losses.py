"""The contrastive preference loss, and the loop that descends it for a whole population."""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives.common import LossModule

from popl_rl.algorithms.draws import Draws, uniform
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.population import Population, added_up
from popl_rl.models.preference_likelihood import drawn_likelihood, log_likelihood
from popl_rl.optim import take_step

__all__ = ["CPLLoss", "answer_losses", "cloning_weight", "cpl_loss", "descend"]


def cpl_loss(
    preferred: Tensor,
    other: Tensor,
    *,
    conservatism: float = 1.0,
    slip: float = 0.0,
    cloning: float | Tensor = 0.0,
) -> Tensor:
    """CPL loss of scored pairs, ``-log sigmoid(S(sigma+) - lambda S(sigma-))``.

    Equation 6 of CPL (Hejna et al., arXiv 2310.13639). With ``conservatism`` below 1, raising the
    likelihood of what was preferred pays even where the margin is large, which keeps the policy
    near the data.

    Args:
        preferred: Scores of the preferred segments, any shape.
        other: Scores of the others, same shape.
        conservatism: Lambda in (0, 1].
        slip: Chance that an answer is a slip, in [0, 0.5), see
            ``popl_rl.models.preference_likelihood.log_likelihood``.
        cloning: Weight of behaviour cloning, of minus the mean score of both segments; one number,
            or one for each member that goes with the scores' shape.

    Returns:
        Losses, same shape.
    """
    loss = -log_likelihood(preferred - conservatism * other, slip)
    return loss if _is_none(cloning) else loss - cloning * (preferred + other) / 2


def _is_none(cloning: float | Tensor) -> bool:
    return not isinstance(cloning, Tensor) and cloning == 0


def answer_losses(
    preferred: Tensor,
    other: Tensor,
    comparisons: Comparisons,
    index: Tensor,
    *,
    conservatism: float = 1.0,
    slip: float = 0.0,
    cloning: float | Tensor = 0.0,
) -> Tensor:
    """CPL losses of drawn answers, as ``cpl_loss``; ties and stages count as what they say.

    Args:
        preferred: Scores of what ``comparisons.together(index)`` preferred, ``[..., B * J]``.
        other: Scores of the others, same shape.
        comparisons: All comparisons.
        index: Those drawn, ``[..., B]`` or ``[B]``.
        conservatism: Lambda in (0, 1].
        slip: Chance that an answer is a slip, in [0, 0.5).
        cloning: Weight of behaviour cloning, of minus the mean score of an answer's segments, as
            ``cpl_loss`` takes it.

    Returns:
        ``[..., B]``, see ``popl_rl.models.preference_likelihood.answer_likelihood``.
    """
    loss = -drawn_likelihood(preferred - conservatism * other, comparisons, index, slip)
    if _is_none(cloning):
        return loss
    score: Tensor = (preferred + other).unflatten(-1, (index.shape[-1], -1)).mean(-1)
    return loss - cloning * score / 2


def cloning_weight(
    bc: float, answers: float | Tensor, *, alpha: float, bank: SegmentBank
) -> float | Tensor:
    """Behaviour cloning that weighs ``bc`` answers, as a weight of scores beside one answer's loss.

    The loss is a mean over answers, so that what weighs as much as ``bc`` of them has a share of
    ``bc / answers``: the more somebody has said, the less the data's own behaviour matters. It is
    the prior of a maximum a posteriori estimate.

    Args:
        bc: How many answers behaviour cloning weighs.
        answers: How many answers are learnt from; a number, or one for each member, ``[N]``.
        alpha: Temperature: scores are ``alpha`` times the sum over a segment's steps.
        bank: The segments.

    Returns:
        0 without cloning, a number, or ``[N, 1]``.
    """
    if bc == 0:
        return 0.0
    weight = bc / (alpha * bank.row.shape[1])
    if not isinstance(answers, Tensor):
        return weight / answers
    # A member that serves nobody is a clone of the data, but not by an endless force.
    return weight / answers.clamp(min=1).float().unsqueeze(1)


class CPLLoss(LossModule):
    """CPL loss of every member of a population, each on a batch of its own.

    Contrastive Preference Learning (Hejna et al., arXiv 2310.13639, equation 6). With reward
    functions and ``conservatism=1`` it is the Bradley–Terry loss on sums of rewards (Christiano et
    al., 2017, equation 1).

    Args:
        population: N members.
        bank: Segments that the batches refer to.
        alpha: Temperature; the scale of the scores.
        conservatism: Lambda in (0, 1].
        discount: Per-step discount gamma.
        slip: Chance that an answer is a slip.
        bc: How many answers behaviour cloning weighs, minus the mean log-likelihood of a step of
            both segments of a pair (of segments without padding and discount): its share in the
            loss is ``bc / num_answers``.

    Attributes:
        num_answers: How many answers the members learn from, one number or ``[N]``, which cloning
            has to know; ``descend`` sets it, None before.

    Raises:
        ValueError: If ``alpha`` is not positive, ``bc`` is negative, or ``conservatism`` or
            ``discount`` is outside (0, 1].

    Example:
        >>> loss = CPLLoss(population, bank, alpha=0.5)  # doctest: +SKIP
        >>> batch = TensorDict(
        ...     {"preferred": torch.randint(100, (8, 32)), "other": torch.randint(100, (8, 32))},
        ...     [8, 32])  # doctest: +SKIP
        >>> loss(batch)["loss_cpl"].backward()  # doctest: +SKIP
    """

    out_keys = ["loss_cpl", "accuracy"]

    def __init__(
        self,
        population: Population,
        bank: SegmentBank,
        *,
        alpha: float = 0.5,
        conservatism: float = 0.9,
        discount: float = 1.0,
        slip: float = 0.0,
        bc: float = 0.0,
    ) -> None:
        super().__init__()
        if not alpha > 0:
            raise ValueError(f"alpha must be positive, got {alpha}")
        if not 0 < conservatism <= 1:
            raise ValueError(f"conservatism must be in (0, 1], got {conservatism}")
        if not 0 < discount <= 1:
            raise ValueError(f"discount must be in (0, 1], got {discount}")
        if not bc >= 0:
            raise ValueError(f"bc must be at least 0, got {bc}")
        self.population = population
        self.bank = bank
        self.alpha = alpha
        self.conservatism = conservatism
        self.discount = discount
        self.slip = slip
        self.bc = bc
        self.num_answers: float | Tensor | None = None
        self._features: Tensor | None = None
        self._cells = bank.row

    @property
    def in_keys(self) -> list[str]:
        """Keys read from a batch."""
        return ["preferred", "other"]

    def scores(self, segment: Tensor) -> Tensor:
        """Differentiable scores of each member's own segments, or of segments that all share.

        Args:
            segment: Segment numbers ``[N, B]``, or ``[B]``, the same for every member.

        Returns:
            ``[N, B]``.
        """
        bank, population = self.bank, self.population
        weight = self.alpha * bank.weights(segment, discount=self.discount)
        if bank.is_shared and len(bank.observation) <= segment.shape[-1] * bank.row.shape[1]:
            value = self._looked_up(segment)
            return added_up(value.view(len(population), segment.shape[-1], -1), weight)
        return population.drawn_scores(bank, segment, weight)

    def _looked_up(self, segment: Tensor) -> Tensor:
        """Scores of steps ``[N, B * T]``: each distinct observation is looked at once."""
        bank, population, spec = self.bank, self.population, self.population.spec
        if self._features is None:
            # What the frozen trunk makes of observations never changes.
            self._features = population.trunk(bank.observation)
            self._cells = bank.row * spec.action_dim + bank.action if spec.discrete else bank.row
        output = population.from_features(self._features)
        count, choices = len(population), output.shape[-1]
        # A choice of rows that lie together: several times as fast as ``self._cells[segment]``.
        cell = self._cells.index_select(0, segment.flatten())
        cell = cell.view(*segment.shape[:-1], -1).expand(count, -1)
        if spec.discrete:
            # Normalise the few distinct rows, not every step of the batch.
            return spec.table(output).flatten(1).gather(1, cell)
        output = output.gather(1, cell.unsqueeze(-1).expand(-1, -1, choices))
        return spec.step_scores(output, bank.action[segment].flatten(-3, -2))

    @property
    def cloning(self) -> float | Tensor:
        """The weight of behaviour cloning that ``cpl_loss`` takes.

        Raises:
            ValueError: If there is some, and nobody has said of how many answers.
        """
        if self.bc == 0:
            return 0.0
        if self.num_answers is None:
            raise ValueError(
                f"num_answers must be set where bc is positive, got None with bc={self.bc}; set it "
                "to the number of answers that each member learns from, or bc=0"
            )
        return cloning_weight(self.bc, self.num_answers, alpha=self.alpha, bank=self.bank)

    def losses(self, preferred: Tensor, other: Tensor) -> Tensor:
        """Losses of scored pairs, any shape."""
        return cpl_loss(
            preferred,
            other,
            conservatism=self.conservatism,
            slip=self.slip,
            cloning=self.cloning,
        )

    def pairs(self, preferred: Tensor, other: Tensor) -> Tensor:
        """Losses of every member on one batch of strict answers that all share.

        Args:
            preferred: Segments that were preferred, ``[B]``.
            other: Segments that these were preferred to, ``[B]``.

        Returns:
            ``[N, B]``.
        """
        return self.losses(*self.scores(torch.cat([preferred, other])).chunk(2, dim=1))

    def answers(self, comparisons: Comparisons, index: Tensor) -> Tensor:
        """Losses of drawn answers; ties and stages count as what they say.

        Args:
            comparisons: M comparisons.
            index: Comparisons of a batch for each member, ``[N, B]``, or of one that all share,
                ``[B]``.

        Returns:
            ``[N, B]``.
        """
        rows = comparisons.together(index)
        segment = torch.cat([comparisons.preferred[rows], comparisons.other[rows]], -1)
        preferred, other = self.scores(segment).chunk(2, dim=1)
        return answer_losses(
            preferred,
            other,
            comparisons,
            index,
            conservatism=self.conservatism,
            slip=self.slip,
            cloning=self.cloning,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of one batch of strict answers per member.

        Args:
            tensordict: Batch size ``[N, B]`` with segment numbers ``preferred`` and ``other``.

        Returns:
            ``loss_cpl``, the members' mean losses summed (their gradients are independent), and
            ``accuracy``, the share of pairs ranked as the rater did, ``[N]``.
        """
        segment = torch.cat([tensordict["preferred"], tensordict["other"]], 1)
        preferred, other = self.scores(segment).chunk(2, dim=1)
        loss = self.losses(preferred, other).mean(1).sum()
        accuracy = (preferred > other).float().mean(1).detach()
        return TensorDict({"loss_cpl": loss, "accuracy": accuracy}, [])


def descend(
    loss: CPLLoss,
    optimizer: torch.optim.Optimizer,
    comparisons: Comparisons,
    *,
    steps: int,
    batch_size: int,
    draws: Draws | None = None,
    generator: torch.Generator,
) -> float:
    """Take gradient steps on the members' CPL losses, all members at once.

    Args:
        loss: Loss of the population to train.
        optimizer: Over the population's parameters.
        comparisons: M comparisons; ties and stages count as what they say.
        steps: Number of steps.
        batch_size: Preferences per member and step, drawn with replacement.
        draws: How often each member draws each comparison; all alike if None.
        generator: Source of the draws.

    Returns:
        The last step's loss, averaged over members.
    """
    count = len(loss.population)
    draws = uniform(comparisons, count) if draws is None else draws
    loss.num_answers = draws.answers
    value = torch.tensor(float("nan"))
    for _ in range(steps):
        index = draws(batch_size, generator)
        if comparisons.all_strict:
            # A call of the module, which runs what is hooked to it.
            batch = {"preferred": comparisons.preferred[index], "other": comparisons.other[index]}
            value = loss(TensorDict(batch, index.shape))["loss_cpl"]
        else:
            value = loss.answers(comparisons, index).mean(1).sum()
        take_step(optimizer, value)
        loss.population.constrain_()
    return float(value.detach()) / count
