"""How people answer, fitted by the response model of simulated raters."""

import math

import pytest
import torch

from popl_rl.experiments.response_study import fit_response, fit_ties
from popl_rl.raters.response import Response


@pytest.mark.parametrize(("rationality", "mistake"), [(1.0, 0.0), (2.0, 0.1)])
def test_the_response_model_is_found_again(rationality, mistake):
    generator = torch.Generator().manual_seed(0)
    sums = torch.randn(20_000, 2, generator=generator, dtype=torch.float64) * 2
    said = Response(rationality=rationality, mistake=mistake).answer(sums, generator)
    found = fit_response((2.0 * said - 1) * (sums[:, 1] - sums[:, 0]))
    assert found[0] == pytest.approx(rationality, rel=0.2)
    assert found[1] == pytest.approx(mistake, abs=0.021)


def test_ties_by_hand():
    """Up to 1 all are ties but one that differs by 5; without the small ones, nothing is."""
    difference = torch.tensor([0.0, -1.0, 1.0, 2.0, 5.0])
    assert fit_ties(difference, torch.tensor([True, True, True, False, True])) == (
        1.0,
        pytest.approx(0.2),
    )
    threshold, error = fit_ties(difference, torch.tensor([False, False, False, False, True]))
    assert math.isnan(threshold)
    assert error == pytest.approx(0.2)


def test_the_preset_is_the_response_of_simulated_raters(config_of):
    response = config_of("response=people").raters.response
    assert (response.rationality, response.mistake, response.tie) == (1.26, 0.0, 0.0)
    assert math.isinf(config_of().raters.response.rationality)
