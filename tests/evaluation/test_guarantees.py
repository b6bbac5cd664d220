import torch

from popl_rl.evaluation.guarantees import undominated


def test_what_no_other_dominates():
    """The third is below the first everywhere; the fourth equals the first in the first column
    alone; the last two are equal, and so neither dominates the other."""
    values = torch.tensor([[1.0, 0.5], [0.5, 1.0], [0.9, 0.4], [1.0, 0.4], [0.7, 0.8], [0.7, 0.8]])
    assert undominated(values).tolist() == [True, True, False, False, True, True]
    assert undominated(values[2:3]).tolist() == [True]
