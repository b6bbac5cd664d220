"""Which observations of segments repeat."""

import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.bank import SegmentBank


def segments(observation):
    action = torch.zeros(observation.shape[:2], dtype=torch.int64)
    return TensorDict({"observation": observation, "action": action}, observation.shape[:2])


def test_observations_that_never_repeat_are_not_compared(monkeypatch):
    """Sorting whole rows is what continuous worlds must not pay for."""
    seen = torch.randn(50, 4, 3, generator=torch.Generator().manual_seed(0))
    calls = []
    real = torch.Tensor.unique

    def counted(self, *args, **kwargs):
        calls.append(kwargs)
        return real(self, *args, **kwargs)

    monkeypatch.setattr(torch.Tensor, "unique", counted)
    bank = SegmentBank.from_segments(segments(seen))
    assert not bank.is_shared
    assert torch.equal(bank.observation[bank.row], seen)
    assert all("dim" not in each for each in calls)


@pytest.mark.parametrize("share", [0.24, 0.26])
def test_the_border_is_at_a_quarter_of_different_rows(share):
    generator = torch.Generator().manual_seed(0)
    distinct = torch.randn(int(share * 400), 3, generator=generator)
    row = torch.arange(400) % len(distinct)
    bank = SegmentBank.from_segments(segments(distinct[row].view(100, 4, 3)))
    assert bank.is_shared == (share < 0.25)
    assert torch.equal(bank.observation[bank.row].flatten(0, 1), distinct[row])


def test_zeros_of_either_sign_are_one_observation():
    seen = torch.zeros(8, 4, 2)
    seen[::2] = -0.0
    bank = SegmentBank.from_segments(segments(seen))
    assert len(bank.observation) == 1
