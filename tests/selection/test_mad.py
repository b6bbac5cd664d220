"""The median absolute deviation, against NumPy."""

import numpy as np
import pytest
import torch

from popl_rl.selection.mad import median_absolute_deviation


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("members", [1, 2, 7, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_median_absolute_deviation_is_numpys(members, dtype):
    scores = torch.randn(members, 300, generator=generator(), dtype=dtype)
    scores[:, :100] = scores[:, :100].round()  # many ties, and both zeros
    values = scores.numpy()
    expected = np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    torch.testing.assert_close(median_absolute_deviation(scores), torch.from_numpy(expected))
