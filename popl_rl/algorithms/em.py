"""A mixture of CPL policies, one for each of K groups, by expectation maximisation.

The baseline that is told how many groups there are: the clustering of MaxMin-RLHF (Chakraborty et
al., 2024, arXiv 2402.08925), with CPL policies in the place of reward models and soft
responsibilities in the place of hard ones. On two doors hard ones were no better where raters are
known, and told two groups apart from preferences alone in none of eight starts, soft ones in two.
"""

from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.multi_cpl import MultiCPL
from popl_rl.algorithms.variation import GradientCPL
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import per_case
from popl_rl.models.scoring import margins
from popl_rl.models.sets import as_set

__all__ = ["EM", "case_likelihood", "responsibility"]


def case_likelihood(margin: Tensor, comparisons: Comparisons) -> Tensor:
    """Log-likelihood of each case's answers under each policy, ``[N, M] -> [N, C]``.

    A case is a rater, who gives all of its answers with one policy in mind, so that their chances
    ``sigmoid(Delta)`` are multiplied; or a single preference.
    """
    return per_case(F.logsigmoid(margin), comparisons)


def responsibility(joint: Tensor) -> Tensor:
    """The E-step: which component of a mixture does each case belong to?

    Args:
        joint: Logarithms of ``share_k * p(case | component k)``, ``[R, K, C]``.

    Returns:
        ``[R, K, C]``, summing to 1 over the K components.
    """
    return joint.softmax(1)


class EM(MultiCPL):
    """Mixtures of K CPL policies from several random starts, of which the likeliest is the result.

    A case, that is a rater or a single preference, belongs to component k with chance
    ``share_k * prod sigmoid(Delta_k)``, normalised over the components (E-step, once a generation);
    then every component takes CPL steps on comparisons drawn by these chances, and shares become
    their means (M-step). A start may end in a poor optimum, so several run side by side.

    Args:
        population: ``R * K`` policies, the K components of a start after those of another; changed
            in place.
        bank: Segments that the comparisons refer to.
        comparisons: M strict preferences and the case of each.
        groups: Components K of a mixture.
        training: The loop that trains the policies, a block of CPL steps for each generation.
        generator: Source of all randomness, the one that ``training`` draws from.

    Attributes:
        share: Shares of the components, ``[R, K]``.

    Raises:
        ValueError: If the population is not made of mixtures of ``groups``.
    """

    def __init__(
        self,
        population: Population,
        bank: SegmentBank,
        comparisons: Comparisons,
        *,
        groups: int,
        training: GradientCPL,
        generator: torch.Generator,
    ) -> None:
        super().__init__(population, bank, comparisons, training=training, generator=generator)
        if groups < 1 or len(population) % groups:
            raise ValueError(
                f"population must hold mixtures of groups={groups} policies each, got "
                f"{len(population)} policies"
            )
        shape = (len(population) // groups, groups)
        self.share = torch.full(shape, 1 / groups, device=bank.row.device)

    def _weights(self, margin: Tensor) -> tuple[Tensor, dict[str, float]]:
        joint = self._joint(margin)
        likelihood = joint.logsumexp(1).mean(1)
        belongs = responsibility(joint)
        self.share = belongs.mean(2)
        about = {
            "log_likelihood": float(likelihood.max()),
            "smallest_share": float(self.share[likelihood.argmax()].min()),
        }
        return belongs.flatten(0, 1)[:, self.comparisons.case], about

    def _joint(self, margin: Tensor) -> Tensor:
        """Log-chance that a component is meant and answers so, ``[R, K, C]``."""
        likelihood = case_likelihood(margin, self.comparisons).unflatten(0, self.share.shape)
        # A component that has lost everything may still win something back.
        joint: Tensor = likelihood + self.share.clamp(min=1e-3).log().unsqueeze(-1)
        return joint

    def likelihood(self) -> Tensor:
        """Mean log-likelihood of a case under each mixture as it is now, ``[R]``."""
        margin = margins(
            self.population, self.bank, self.comparisons, alpha=self.alpha, discount=self.discount
        )
        likelihood: Tensor = self._joint(margin).logsumexp(1).mean(1)
        return likelihood

    def policies(self) -> HypothesisSet:
        """The components of the likeliest mixture."""
        groups = self.share.shape[1]
        first = int(self.likelihood().argmax()) * groups
        everybody = as_set(self.population, alpha=self.alpha, discount=self.discount)
        return everybody.subset(range(first, first + groups))

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        return {**super().state_dict(), "share": self.share.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`, bit for bit."""
        super().load_state_dict(state)
        self.share = state["share"].clone()
