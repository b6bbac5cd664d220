from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.response import Response
from popl_rl.raters.values import fit_value, with_values


@pytest.fixture(scope="module")
def walk():
    """Segments of 4 steps along a line of ten places, each step to the right worth 1 until 9."""
    start = torch.randint(8, (400,), generator=torch.Generator().manual_seed(0)).float()
    place = (start.unsqueeze(1) + torch.arange(4)).clamp(max=9)
    return TensorDict({"observation": place.unsqueeze(-1)}, [400, 4])


def utility(segments):
    return (segments["observation"][..., 0] < 9).float()


@pytest.fixture(scope="module")
def value(walk):
    return fit_value(walk, utility(walk), generator=torch.Generator().manual_seed(0))


def test_worth_travels_back_from_segment_to_segment(value):
    """At place p there are 9 - p steps to go, more than one segment shows."""
    places = torch.arange(10.0).unsqueeze(-1)
    assert (value(places) - (9 - torch.arange(10.0))).abs().max() < 1.0
    assert value(places)[0] > 7


def test_the_sum_of_advantages_is_what_was_gained_beyond_the_value(walk):
    """With V(p) = p: u = 1 a step and one place further, but nothing known of the last step."""
    group = RaterGroup("steps", utility, Response(), "regret", value=lambda seen: seen[..., 0])
    segment = TensorDict({"observation": torch.tensor([[[2.0], [3.0], [4.0], [5.0]]])}, [1, 4])
    assert group.perceived_utility(segment).tolist() == [[2.0, 2.0, 2.0, 0.0]]
    assert group.segment_utility(segment).tolist() == [3 + 5 - 2]


def test_groups_compare_by_fitted_values(walk, value):
    groups = [RaterGroup("steps", utility, Response())]
    (fitted,) = with_values(groups, walk, generator=torch.Generator().manual_seed(0))
    again = replace(groups[0], label="regret", value=value)  # fitted with the same seed
    (other,) = with_values(groups, walk, generator=torch.Generator().manual_seed(1))
    assert fitted.label == "regret"
    assert torch.equal(fitted.segment_utility(walk), again.segment_utility(walk))
    assert not torch.equal(fitted.segment_utility(walk), other.segment_utility(walk))
    # Everybody walks alike, so nobody gains anything on anybody.
    assert fitted.segment_utility(walk).abs().mean() < 0.5 < groups[0].segment_utility(walk).mean()


def test_regret_needs_one_of_two():
    message = "needs either advantages .* or the value of a state"
    with pytest.raises(ValueError, match=message):
        RaterGroup("x", utility, Response(), "regret")
    with pytest.raises(ValueError, match="with advantages and value"):
        RaterGroup(
            "x", utility, Response(), "regret", advantages=torch.zeros(2, 2), value=torch.zeros_like
        )
    with pytest.raises(ValueError, match="with value"):
        RaterGroup("x", utility, Response(), "return", value=torch.zeros_like)
