"""Individual raters, each of one hidden group."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.raters.groups import RaterGroup

__all__ = ["Raters"]


@dataclass(frozen=True, eq=False)
class Raters:
    """Individuals, each of one hidden group.

    Attributes:
        groups: The groups.
        group_of: ``[R]`` int64, the group of each rater; a rater's id is its position.
            ``len()`` counts raters.

    Raises:
        ValueError: If there are no groups or raters, or a rater's group does not exist.
    """

    groups: tuple[RaterGroup, ...]
    group_of: Tensor

    def __post_init__(self) -> None:
        if not self.groups:
            raise ValueError("groups must hold at least one rater group, got none.")
        if self.group_of.ndim != 1 or not len(self.group_of):
            raise ValueError(
                "group_of must have shape [raters] with at least one, got "
                f"{list(self.group_of.shape)}."
            )
        low, high = int(self.group_of.min()), int(self.group_of.max())
        if low < 0 or high >= len(self.groups):
            raise ValueError(
                f"group_of must lie in 0..{len(self.groups) - 1}, got values from {low} to {high}."
            )

    @classmethod
    def draw(
        cls,
        groups: Sequence[RaterGroup],
        *,
        num_raters: int,
        shares: Sequence[float] | None = None,
        generator: torch.Generator,
    ) -> "Raters":
        """Draw raters, each independently of a group with probability ``shares``.

        A group with a positive share that came out empty then takes one rater (the last) from the
        group that has most, so that every such group has somebody, as long as there are as many
        raters as groups.

        Args:
            groups: The groups.
            num_raters: Number of raters, at least 1.
            shares: Probability of each group, summing to 1. None makes all groups equally likely.
            generator: Source of randomness.

        Raises:
            ValueError: If ``num_raters`` is below 1 or ``shares`` are no probabilities of the
                groups.
        """
        if not groups:
            raise ValueError("groups must hold at least one rater group, got none.")
        if num_raters < 1:
            raise ValueError(f"num_raters must be at least 1, got {num_raters}.")
        wanted = [1 / len(groups)] * len(groups) if shares is None else [float(s) for s in shares]
        if len(wanted) != len(groups):
            raise ValueError(
                f"shares must have one value per group: {len(groups)} groups "
                f"({', '.join(group.name for group in groups)}), got {len(wanted)} shares."
            )
        if not all(share >= 0 for share in wanted) or not abs(sum(wanted) - 1) <= 1e-6:
            raise ValueError(
                f"shares must be at least 0 and sum to 1, got {wanted} with sum {sum(wanted):g}."
            )
        weights = torch.tensor(wanted, dtype=torch.float64, device=generator.device)
        group_of = torch.multinomial(weights, num_raters, replacement=True, generator=generator)
        if num_raters >= len(groups):
            for index, share in enumerate(wanted):
                if share > 0 and not bool((group_of == index).any()):
                    largest = group_of.bincount(minlength=len(groups)).argmax()
                    group_of[(group_of == largest).nonzero()[-1]] = index
        return cls(tuple(groups), group_of)

    def __len__(self) -> int:
        return len(self.group_of)

    def segment_utility(self, segments: TensorDictBase) -> Tensor:
        """Return what each segment is worth to each group, float32 ``[G, N]``.

        Raises:
            ValueError: As ``RaterGroup.perceived_utility``.
            TypeError: As ``RaterGroup.perceived_utility``.
        """
        return torch.stack([group.segment_utility(segments) for group in self.groups])

    def answer(
        self, pairs: Tensor, rater: Tensor, segment_utility: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Answer pairs, each as the rater who is asked would.

        Args:
            pairs: ``[M, 2]`` int64, rows of the two segments.
            rater: ``[M]`` int64, who is asked.
            segment_utility: ``[G, N]`` float, what each segment is worth to each group, from
                ``segment_utility``.
            generator: Source of randomness, on the device of ``segment_utility``.

        Returns:
            ``[M]`` int64, each an ``popl_rl.keys.Answer``.

        Raises:
            ValueError: If shapes do not fit together.
        """
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ValueError(f"pairs must have shape [pairs, 2], got {list(pairs.shape)}.")
        if rater.shape != pairs.shape[:1]:
            raise ValueError(
                f"rater must have shape [{len(pairs)}], one per pair, got {list(rater.shape)}."
            )
        if segment_utility.ndim != 2 or len(segment_utility) != len(self.groups):
            raise ValueError(
                f"segment_utility must have shape [{len(self.groups)} groups, segments], got "
                f"{list(segment_utility.shape)}."
            )
        group = self.group_of.to(rater.device)[rater]
        sums = segment_utility[group.unsqueeze(1), pairs]
        answers = torch.empty_like(rater)
        for index, member in enumerate(self.groups):
            asked = group == index
            answers[asked] = member.response.answer(sums[asked], generator)
        return answers
