"""The check of a frozen feature extractor, with good ones and many faulty ones."""

from itertools import count

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from popl_rl.testing import check_features, tiny_env

VIEW = {"view": "partial"}  # of the lava gap: images [7, 7, 3] of uint8
calls = count(1)


class Net(nn.Module):
    """Random weights, and drop-out, which a frozen module leaves out."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(147, 4), nn.Dropout(0.5))

    def forward(self, images):
        return self.layers(images.float())


def means(images):
    return images.float().mean((1, 2))


def maps(images):
    """Features of any shape are one vector."""
    return images.permute(0, 3, 1, 2)


def one_vector(images):
    return images.float().flatten()


def one_for_all(images):
    return means(images)[:1]


def a_list(images):
    return means(images).tolist()


def complex_numbers(images):
    return torch.fft.fft(means(images))


def none(images):
    return means(images)[:, :0]


def logarithms(images):
    return means(images - images.float()).log()


def changes_what_is_shown(images):
    images //= 2
    return means(images)


def noisy(images):
    return means(images) + torch.rand(())


def counts(images):
    return means(images) + next(calls)


def normalises(images):
    return means(images) - means(images).mean(0)


def squeezes(images):
    return means(images).squeeze() if len(images) > 1 else torch.zeros(1, 2)


def with_gradients(images):
    with torch.enable_grad():
        return means(images) * torch.ones(3, requires_grad=True)


def wants_batches(images):
    return nn.BatchNorm1d(3)(means(images))


def blind(images):
    raise RuntimeError("cannot see")


def makes_a_number():
    return 7


def of_numpys_weights():
    layer = nn.Linear(147, 4)
    layer.weight.data[:] = torch.from_numpy(np.random.default_rng().random((4, 147)))
    return nn.Sequential(nn.Flatten(), ToFloat(), layer)


class ToFloat(nn.Module):
    def forward(self, images):
        return images.float()


BROKEN = [
    (7, TypeError, "'int' must be a torch.nn.Module, what makes one, or a function"),
    (makes_a_number, TypeError, "'makes_a_number': what takes no argument must return a torch.nn"),
    (one_vector, TypeError, r"'one_vector' must return numbers of shape \[16, F\].*got \[2352\]"),
    (one_for_all, TypeError, r"got \[1, 3\]"),
    (a_list, TypeError, "got list"),
    (complex_numbers, TypeError, r"must return numbers of shape \[16, F\]"),
    (none, ValueError, "must be one or more finite numbers for an observation, got none"),
    (logarithms, ValueError, "got values that are not"),
    (changes_what_is_shown, ValueError, "must leave observations as they are, but changed them"),
    (noisy, ValueError, "'noisy' must be the same each time, but a second call differed"),
    (counts, ValueError, "'counts' must be the same each time"),
    (normalises, ValueError, "'normalises' must read each observation by itself"),
    (squeezes, ValueError, "must have one length, got 3 for many observations and 2 for one"),
    (with_gradients, ValueError, r"must be read without gradients.*features\.detach\(\)"),
    (wants_batches, ValueError, "reading observations failed with ValueError"),
    (blind, ValueError, "'blind': reading observations failed with RuntimeError: cannot see"),
    (of_numpys_weights, ValueError, "must be the same in every process, but differ where it is"),
]


@pytest.mark.parametrize(("features", "error", "message"), BROKEN)
def test_each_fault_of_an_extractor_is_found(features, error, message):
    with pytest.raises(error, match=message):
        check_features(features, "lava_gap", **VIEW)


@pytest.mark.parametrize("features", [Net, Net(), means, maps, f"{__name__}:Net"])
def test_good_extractors_pass_and_leave_the_global_randomness_alone(features):
    before = torch.random.get_rng_state()
    check_features(features, "lava_gap", **VIEW)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_who_tells_no_observations_apart_is_warned():
    def nothing(images):
        return torch.zeros(len(images), 4)

    with pytest.warns(UserWarning, match="'nothing' are the same for all 16 observations"):
        check_features(nothing, "lava_gap", **VIEW)


def test_it_reads_what_the_environment_shows():
    check_features(lambda shown: shown[:, :5], tiny_env)
    with pytest.raises(ValueError, match="reading observations failed with RuntimeError"):
        check_features(Net, tiny_env)
    with pytest.raises(TypeError, match="observations that are a Box, got Discrete"):
        check_features(means, gymnasium.make("FrozenLake-v1"))
    gatherer = tiny_env()
    gatherer.collect_segments = lambda *_, **__: None
    with pytest.raises(ValueError, match="collects segments itself, so that its features are not"):
        check_features(means, gatherer)
    with pytest.raises(ValueError, match="has no 'nowhere'"):
        check_features(f"{__name__}:nowhere", tiny_env)
