"""What lexicase selection says about wrong arguments."""

import math

import pytest
import torch
from torch import Tensor

from popl_rl.selection.lexicase import lexicase_selection


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"scores": [[1.0]]}, TypeError, r"scores must be a torch.Tensor, got list"),
        (
            {"scores": torch.ones(2, 2, dtype=torch.complex64)},
            TypeError,
            "scores must be bool, int",
        ),
        ({"scores": torch.ones(3)}, ValueError, r"\[member, case\] matrix, got shape \(3,\)"),
        ({"scores": torch.ones(0, 3)}, ValueError, r"at least one member .* shape \(0, 3\)"),
        ({"scores": torch.ones(3, 0)}, ValueError, r"and one case, got shape \(3, 0\)"),
        (
            {"scores": torch.tensor([[1.0, torch.nan], [torch.nan, torch.inf]])},
            ValueError,
            "scores must not contain NaN, got 2 of them",
        ),
        ({"num_selected": 0}, ValueError, "num_selected must be at least 1, got 0"),
        ({"num_selected": 2.0}, TypeError, "num_selected must be an int, got float"),
        ({"num_selected": True}, TypeError, "num_selected must be an int, got bool"),
        ({"epsilon": -0.1}, ValueError, "epsilon must be finite and at least 0, got -0.1"),
        ({"epsilon": math.nan}, ValueError, "epsilon must be finite and at least 0, got nan"),
        ({"epsilon": math.inf}, ValueError, "epsilon must be finite and at least 0"),
        ({"epsilon": torch.tensor([0.1, -1.0, 0.0])}, ValueError, "at least 0, got -1.0 to 0.1"),
        ({"epsilon": torch.ones(2)}, ValueError, r"shape \(3,\), got shape \(2,\)"),
        ({"epsilon": "median"}, ValueError, "'mad' or None, got 'median'"),
        ({"epsilon": [0.1, 0.1, 0.1]}, TypeError, "epsilon must be .* got list"),
        ({"epsilon": True}, TypeError, "epsilon must be .* got bool"),
        ({"epsilon": 0.1, "epsilon_mode": "full"}, ValueError, "got 'full'; use 'semi-dynamic'"),
        (
            {"scores": torch.full((2, 3), -torch.inf), "epsilon": "mad"},
            ValueError,
            "scores must be finite if epsilon is 'mad'",
        ),
        ({"cases_per_selection": 4}, ValueError, "from 1 to 3, the number of cases, got 4"),
        ({"cases_per_selection": 0}, ValueError, "cases_per_selection must be from 1 to 3"),
        ({"cases_per_selection": 1.5}, TypeError, "cases_per_selection must be an int, got float"),
        ({"generator": 7}, TypeError, r"torch.Generator, got int; make one with"),
        (
            {"scores": torch.ones(2, 3, device="meta")},
            ValueError,
            "on the device of scores, meta, got cpu",
        ),
    ],
)
def test_mistakes_are_explained(change, error, message):
    scores = torch.rand(4, 3, generator=generator())
    arguments = {"scores": scores, "num_selected": 5, "generator": generator()} | change
    if isinstance(scores := arguments["scores"], Tensor) and scores.is_meta:
        arguments["scores"] = scores.int()  # has no values to check first
    with pytest.raises(error, match=message):
        lexicase_selection(**arguments)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_generator_and_scores_must_be_on_one_device():
    with pytest.raises(ValueError, match="generator must be on the device of scores"):
        lexicase_selection(torch.eye(3, device="cuda").bool(), 5, generator=generator())
