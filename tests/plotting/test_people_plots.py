"""Curves over people and walks on a delivery grid are drawn from what they are given."""

import pandas as pd
import pytest
import torch

from popl_rl.envs.delivery import DeliveryGrid
from popl_rl.plotting.delivery_plots import delivery_walks
from popl_rl.plotting.people_plots import people_curves


def test_curves_are_the_rows_values():
    measures = {"accuracy@0": 0.5, "accuracy@5": 0.8, "accuracy_low@0": 0.4, "accuracy_high@0": 0.6}
    measures |= {"accuracy_low@5": 0.7, "accuracy_high@5": 0.9, "log_likelihood@0": -0.7}
    rows = [("popl", "posterior", "all", name, value) for name, value in measures.items()]
    table = pd.DataFrame(rows, columns=["method", "choice", "group", "measure", "value"])
    left, right = people_curves(table).axes
    assert left.lines[0].get_ydata().tolist() == [0.5, 0.8]
    assert [each.get_text() for each in left.get_xticklabels()] == ["0", "5"]
    assert right.get_legend().get_texts()[0].get_text() == "POPL (catered)"
    with pytest.raises(ValueError, match="accuracies of the group 'nobody', got none"):
        people_curves(table, group="nobody")


def test_arrows_tell_where_the_way_ends():
    grid = DeliveryGrid()
    right, down = torch.full((16,), 3), torch.full((16,), 1)
    fig = delivery_walks(grid, {"right": right, "down": down})
    assert [ax.get_title() for ax in fig.axes] == ["right", "down"]
    arrows = [text for text in fig.axes[0].texts if text.get_text() == ""]
    assert len(arrows) == int(grid.open.sum())
    with pytest.raises(ValueError, match="policies must hold one or more"):
        delivery_walks(grid, {})
