"""What distributional preference learning refuses."""

import math

import pytest
import torch
from torch import nn

from popl_rl.algorithms.dpl import DistributionalReward, train_dpl
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons


def single_steps(state):
    """A bank of segments of one step each, observations ``[N, O]``."""
    rows = torch.arange(len(state)).unsqueeze(1)
    return SegmentBank(state, rows, torch.zeros_like(rows), False)


def preferences_of(preferred, other):
    count = len(preferred)
    return Comparisons(
        torch.as_tensor(preferred), torch.as_tensor(other), torch.arange(count), count
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "median"}, r"kind must be one of \('mean_variance', 'categorical'\), got 'med"),
        ({"atoms": 1}, "atoms must be at least 2, got 1; a single utility ranks nothing"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"learning_rate": 0.0}, "learning_rate must be positive and finite, got 0.0"),
        ({"learning_rate": math.nan}, "learning_rate must be positive and finite, got nan"),
        ({"entropy": -0.1}, "entropy must be finite and at least 0, got -0.1"),
        ({"hidden": (0,)}, r"hidden must hold layer widths of at least 1, got \(0,\)"),
    ],
)
def test_bad_settings_are_refused(bank, comparisons, generator, settings, message):
    with pytest.raises(ValueError, match=message):
        train_dpl(bank, comparisons, **{"kind": "categorical", **settings}, generator=generator)


def test_an_unknown_kind_of_model_is_refused():
    with pytest.raises(ValueError, match=r"kind must be one of .*, got 'normal'"):
        DistributionalReward(nn.Sequential(nn.Linear(1, 2)), "normal")


def test_data_that_teach_nothing_are_refused(bank, comparisons, generator):
    def train(bank, comparisons):
        train_dpl(bank, comparisons, kind="mean_variance", generator=generator)

    with pytest.raises(ValueError, match=r"comparisons must hold at least one .* got none"):
        train(bank, comparisons.rows(torch.arange(0)))
    with pytest.raises(ValueError, match="bank must hold different observations, got 3 equal ones"):
        train(single_steps(torch.ones(3, 2)), preferences_of([0, 1], [1, 2]))
    same = "comparisons must hold a pair of segments with different observations, but in all 2 both"
    with pytest.raises(ValueError, match=same):
        train(bank, preferences_of([0, 1], [0, 1]))
