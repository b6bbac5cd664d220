"""Segments that differ in length score what their own steps say, whichever way they are scored."""

import pytest
import torch
from tensordict import TensorDict

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.reward_baselines import segment_features
from popl_rl.data.bank import SegmentBank
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import segment_scores

LENGTHS = (4, 1, 3)
SPECS = {
    "policies": PolicySpec(3, 2, True, (5,)),
    "linear policies": PolicySpec(3, 2, True, ()),
    "rewards": RewardSpec(3, 2, (5,)),
    "linear rewards": RewardSpec(3, 2, ()),
}


def segments(*, few):
    """Three segments, padded with garbage; ``few`` different observations or all different."""
    generator = torch.Generator().manual_seed(1)
    seen = torch.rand(2 if few else 12, 3, generator=generator)
    row = torch.arange(12).view(3, 4) % len(seen)
    action = torch.randint(2, (3, 4), generator=generator)
    mask = torch.arange(4) < torch.tensor(LENGTHS).unsqueeze(1)
    return TensorDict({"observation": seen[row], "action": action, "mask": mask}, [3, 4])


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("name", SPECS)
def test_scores_are_those_of_the_cut_segments(name, few, generator):
    spec, whole = SPECS[name], segments(few=few)
    population = Population.create(spec, 3, generator=generator)
    found = segment_scores(population, spec.bank(whole), alpha=0.7, discount=0.9)
    for segment, length in enumerate(LENGTHS):
        cut = whole[segment : segment + 1, :length].exclude("mask").auto_batch_size_(2)
        own = segment_scores(population, spec.bank(cut), alpha=0.7, discount=0.9)
        torch.testing.assert_close(found[:, segment], own[:, 0])
    loss = CPLLoss(population, spec.bank(whole), alpha=0.7, discount=0.9)
    torch.testing.assert_close(loss.scores(torch.arange(3).expand(3, -1)), found)


def test_banks_keep_their_masks(generator):
    bank = SegmentBank.from_segments(segments(few=False))
    assert bank.subset(torch.tensor([2, 1])).mask.sum(1).tolist() == [3, 1]
    assert bank.to("cpu").mask.sum(1).tolist() == [4, 1, 3]
    sums = segment_features(torch.nn.Identity(), bank, 2).view(3, 2, 3).sum(1)
    torch.testing.assert_close(sums[1], segments(few=False)["observation"][1, 0])
