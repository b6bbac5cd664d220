from types import SimpleNamespace

import pytest
import torch
from torch import nn

from popl_rl.evaluation.guarantees import guarantees, undominated
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population


def test_what_no_other_dominates():
    """The third is below the first everywhere; the fourth equals the first in the first column
    alone; the last two are equal, and so neither dominates the other."""
    values = torch.tensor([[1.0, 0.5], [0.5, 1.0], [0.9, 0.4], [1.0, 0.4], [0.7, 0.8], [0.7, 0.8]])
    assert undominated(values).tolist() == [True, True, False, False, True, True]
    assert undominated(values[2:3]).tolist() == [True]


def policies(count):
    """Policies with random weights, which rank segments differently."""
    networks = [nn.Sequential(nn.Linear(5, 2)) for _ in range(count)]
    return PolicySet(Population(networks, PolicySpec(5, 2, True, ())))


@pytest.fixture
def accuracies():
    """Of four members, and of the oracles of two groups.

    The first member is dominated by the first oracle, the second by nobody, the third by the second
    member, and the fourth is as good as the second oracle, which so does not dominate it.
    """
    members = torch.tensor([[0.9, 0.2], [0.6, 0.7], [0.5, 0.7], [0.4, 0.9]])
    return {4: members, 2: torch.tensor([[1.0, 0.2], [0.4, 0.9]])}


def test_oracles_may_dominate_members(accuracies, bank, comparisons, groups, segments):
    found = policies(4)
    utility = torch.stack([group.segment_utility(segments) for group in groups])
    likes_left, likes_right = utility
    likes_ends = (likes_left - likes_left.mean()).abs()
    evaluator = SimpleNamespace(
        groups=groups,
        segment_utility=utility,
        shares=None,
        pool=None,
        seed=0,
        # Four rankings: each group's own, and two that are nobody's.
        scores=lambda _: torch.stack([likes_left, likes_right, likes_ends, -likes_ends]),
        accuracy=lambda of: accuracies[len(of)],
    )
    told = guarantees(found, policies(2), evaluator, bank=bank, training=comparisons)
    assert told["members"] == 4
    assert told["undominated_beside_oracles"] == 2  # the second and the fourth
    assert told["undominated"] >= 2  # those who rank as a group does
    assert told["best_accuracy"] == pytest.approx((0.9 + 0.9) / 2)
    assert told["oracle_accuracy"] == pytest.approx((1.0 + 0.9) / 2)
