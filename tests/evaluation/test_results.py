"""Tidy rows in the making: what single raters are given."""

import math

import pytest
import torch

from popl_rl.evaluation.protocol import MeasuredInfos
from popl_rl.evaluation.results import Rows, weighted_quantile
from popl_rl.raters.groups import make_groups


def test_the_quantile_counts_weights():
    """Of ten raters the lowest is the 10 % quantile; where it weighs less, it is the next."""
    values = torch.arange(10.0).flip(0)
    assert weighted_quantile(values, torch.ones(10) / 10, level=0.1) == 0
    assert weighted_quantile(values, torch.ones(10), level=0.25) == 2
    rare = torch.tensor([0.3, 0.3, 0.35, 0.05])
    assert weighted_quantile(torch.tensor([3.0, 2.0, 1.0, 0.0]), rare, level=0.1) == 1


def test_unknown_values_count_unless_nobody_is_given_them():
    values = torch.tensor([math.nan, 1.0])
    assert math.isnan(weighted_quantile(values, torch.tensor([0.01, 0.99]), level=0.1))
    assert weighted_quantile(values, torch.tensor([0.0, 1.0]), level=0.1) == 1


@pytest.mark.parametrize(("shares", "expected"), [(None, 0.5), ([0.25, 0.75], 0.9)])
def test_raters_count_in_the_shares_of_their_groups(shares, expected):
    """One of five raters of the first group has 0.5: 10 % of all, if its group is half of all."""
    names = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]
    groups = make_groups(names, label="return")
    unknown = torch.full((2,), math.nan)
    rows = Rows(groups, MeasuredInfos(""), floor=unknown, oracle=unknown, shares=shares)
    own = torch.tensor([0.5, 0.9, 0.9, 0.9, 1.0])
    rows.add_accuracy(("popl", "posterior"), 0, catered=own, best=1.0)
    rows.add_accuracy(("popl", "posterior"), 1, catered=torch.full((5,), 0.95), best=1.0)
    rows.add_worst()
    found = {measure: value for _, _, group, measure, value in rows.rows if group == "all"}
    assert found["rater_quantile_accuracy"] == pytest.approx(expected)
