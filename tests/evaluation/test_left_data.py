"""Policies that leave the data are told apart from those that stay, and a run says so."""

import pandas as pd
import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.bank import SegmentBank
from popl_rl.evaluation.diagnostics import left_data
from popl_rl.evaluation.left_data import DataRegion, score_region
from popl_rl.evaluation.protocol import MeasuredInfos
from popl_rl.evaluation.results import Rows
from popl_rl.evaluation.statistics import RESULT_COLUMNS


@pytest.fixture
def drawn(generator):
    """200 segments of 10 steps; the second number is a thousand times the first one's scale."""
    observation = torch.randn(200, 10, 2, generator=generator) * torch.tensor([1.0, 1000.0])
    action = torch.zeros(200, 10, dtype=torch.int64)
    steps = {"observation": observation, "action": action}
    return SegmentBank.from_segments(TensorDict(steps, [200, 10]))


def test_what_is_like_the_data_is_inside_and_what_is_far_is_not(drawn, generator):
    region = DataRegion(drawn, seed=0)
    alike = torch.randn(2000, 2, generator=generator) * torch.tensor([1.0, 1000.0])
    assert region.share(alike) == pytest.approx(0.95, abs=0.02)
    assert region.share(alike + torch.tensor([10.0, 0.0])) == 0
    assert region.share(
        alike + torch.tensor([10.0, 0.0]) * (torch.arange(2000) < 1000)[:, None]
    ) == pytest.approx(0.475, abs=0.02)
    assert region.share(alike + torch.tensor([0.0, 10.0])) > 0.9  # small for that number


def test_a_new_start_is_not_far_because_segments_share_theirs(generator):
    """Walks of which two begin alike and stay close: the other one held out would say little."""
    spread = torch.randn(1200, 1, 3, generator=generator) * 5
    walk = torch.arange(10.0)[:, None] * 0.01 * torch.ones(3)
    noise = 0.001 * torch.randn(800, 10, 3, generator=generator)
    noise[:, 0] = 0
    observation = spread[torch.arange(800) % 400] + walk + noise
    steps = {"observation": observation, "action": torch.zeros(800, 10, dtype=torch.int64)}
    region = DataRegion(SegmentBank.from_segments(TensorDict(steps, [800, 10])), seed=0)
    fresh = (spread[400:] + walk).flatten(0, 1)
    assert region.share(fresh) == pytest.approx(0.95, abs=0.03)


def test_segments_of_a_few_starts_are_held_out_one_by_one(generator):
    begin = torch.tensor([[0.0], [100.0]])[torch.arange(200) % 2]
    walk = torch.arange(10.0) + 0.01 * torch.randn(200, 10, generator=generator)
    walk[:, 0] = 0
    observation = (begin + walk).unsqueeze(-1)
    steps = {"observation": observation, "action": torch.zeros(200, 10, dtype=torch.int64)}
    assert DataRegion(SegmentBank.from_segments(TensorDict(steps, [200, 10])), seed=0).edge < 0.01


def test_steps_after_an_episode_and_fillers_of_segments_do_not_count(drawn, groups):
    mask = torch.arange(10) < 5
    filled = drawn.observation.view(200, 10, 2).clone()
    filled[:, 5:] = 1e6
    steps = {"observation": filled, "action": drawn.action, "mask": mask.expand(200, 10)}
    bank = SegmentBank.from_segments(TensorDict(steps, [200, 10]))
    assert DataRegion(bank, seed=0).edge < 1
    unknown = torch.full((2,), torch.nan)
    rows = Rows(groups, MeasuredInfos(success="", door=None), floor=unknown, oracle=unknown)
    episodes = TensorDict(
        {"observation": filled[None, :20], "mask": mask.expand(1, 20, 10)}, [1, 20, 10]
    )
    gone = episodes.clone().set("observation", episodes["observation"] + 1e7)
    score_region(rows, "popl", bank, [episodes, gone], seed=0)
    table = rows.table()
    assert table.measure.tolist() == ["inside_data"] * 2
    assert table.value[0] > 0.9
    assert table.value[1] == 0


def test_nothing_is_measured_where_observations_repeat(bank, groups):
    assert bank.is_shared
    unknown = torch.full((2,), torch.nan)
    rows = Rows(groups, MeasuredInfos(success="", door=None), floor=unknown, oracle=unknown)
    score_region(rows, "popl", bank, [], seed=0)
    assert rows.table().empty


def test_a_run_says_who_has_left_the_data():
    rows = [
        ("popl", "posterior", name, "inside_data", value)
        for name, value in (("quick", 0.79), ("smooth", 0.8))
    ]
    found = pd.DataFrame(rows, columns=RESULT_COLUMNS)
    assert "95% of held-out data are 79% for quick of their steps" in left_data(found)
    assert left_data(found[found.group == "smooth"]) is None
