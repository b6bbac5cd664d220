"""The median absolute deviation, against NumPy."""

import numpy as np
import pytest
import torch

from popl_rl.selection.mad import mad


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("members", [1, 2, 7, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_median_absolute_deviation_is_numpys(members, dtype):
    scores = torch.randn(members, 300, generator=generator(), dtype=dtype)
    scores[:, :100] = scores[:, :100].round()  # many ties, and both zeros
    values = scores.numpy()
    expected = np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    torch.testing.assert_close(mad(scores), torch.from_numpy(expected))


def test_of_an_even_number_by_hand():
    """The median of 0, 0, 1, 1 is 1/2, from which all are 1/2 away.

    Of 0, 2, 4, 10 it is 3; the distances 3, 1, 1, 7 have the median (1 + 3) / 2.
    """
    values = torch.tensor([[0.0, 0.0, 1.0, 1.0], [0.0, 2.0, 4.0, 10.0]]).T
    assert mad(values).tolist() == [0.5, 2.0]
