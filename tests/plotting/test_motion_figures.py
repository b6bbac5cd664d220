"""Which policies are rolled out for the picture of how they move."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.rollouts import MASK
from popl_rl.evaluation.results import Performance, Scoreboard, Served
from popl_rl.keys import INFO
from popl_rl.plotting.motion_figures import places_of

PEAKS = torch.tensor([3.0, 1.0, 4.0, 1.5])  # by member


def episodes_of(members):
    """Two episodes of two steps each, whose first step is the fastest and does the task."""
    speed = PEAKS[members].view(-1, 1, 1) * torch.tensor([1.0, 0.5]).expand(len(members), 2, 2)
    info = {"speed": speed, "done": torch.ones(len(members), 2, 2)}
    mask = torch.ones(len(members), 2, 2, dtype=torch.bool)
    return TensorDict({INFO: info, MASK: mask}, [len(members), 2, 2])


@pytest.mark.parametrize("served", [None, [2], [3, 1, 0, 2]])
def test_members_that_were_rolled_out_are_not_rolled_again(served):
    rolled = []

    def act(members):
        rolled.extend(members)
        return episodes_of(members)

    infos = SimpleNamespace(success="done", measured=["speed"])
    evaluator = SimpleNamespace(acting=act, infos=infos)
    known = None
    if served is not None:
        known = Served({}, served, Performance(episodes_of(served), None), 0)
    board = Scoreboard(None, {}, {}, served=known)
    found = SimpleNamespace(subset=list)
    places = places_of(found, 4, board, evaluator)
    assert places[:, 0].tolist() == [1] * 4
    torch.testing.assert_close(places[:, 1], PEAKS)
    assert rolled == [member for member in range(4) if member not in (served or [])]
