"""Policies that begin with convolutions, alone and stacked."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import conv2d

from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.config import MethodConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import make_world
from popl_rl.experiments.builders import build_spec
from popl_rl.keys import ANSWER, PAIR, RATER
from popl_rl.models.convolutions import image_layers
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.scoring import segment_scores

SPEC = PolicySpec(75, 2, True, (16,), image=(5, 5, 3), channels=(4, 6), image_scale=10.0)


class Spots(gymnasium.Env):
    """A bright pixel left or right; nothing comes of what is done."""

    observation_space = gymnasium.spaces.Box(0, 255, (5, 5, 1), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        return self.draw(), {}

    def step(self, action):  # noqa: ARG002
        return self.draw(), 0.0, False, False, {}

    def draw(self):
        image = np.zeros((5, 5, 1), np.uint8)
        image[self.np_random.integers(5), self.np_random.choice([0, 1, 3, 4])] = 255
        return image


@pytest.mark.parametrize("shape", [(7, 7, 3), (3, 7, 6), (20, 24, 1)])
def test_patches_and_a_linear_layer_are_a_convolution(shape):
    layers, features = image_layers(shape, (5,), scale=2.0)
    patches, linear, _, joined = layers
    images = torch.rand(4, *shape, generator=torch.Generator().manual_seed(0))
    pixels = images if shape[0] == 3 else images.movedim(-1, 1)
    depth = pixels.shape[1]
    kernel = linear.weight.view(5, depth, patches.kernel, patches.kernel)
    expected = conv2d(pixels / 2, kernel, linear.bias, stride=patches.stride)
    got = joined(linear(patches(images.flatten(1))))
    assert got.shape == (4, features)
    assert torch.allclose(got, expected.movedim(1, -1).flatten(1), atol=1e-5)


def test_stacked_members_see_what_each_sees_alone():
    generator = torch.Generator().manual_seed(0)
    population = Population.create(SPEC, 3, generator=generator)
    images = torch.randint(10, (6, 75), generator=generator).float()
    stacked = population(images)
    own = population(images.expand(3, 6, 75))
    for member in range(3):
        alone = population.network(member)(images)
        assert torch.allclose(stacked[member], alone, atol=1e-5)
        assert torch.allclose(own[member], alone, atol=1e-5)


@pytest.mark.parametrize("evolve", ["all", "head"])
def test_scores_of_segments(evolve):
    generator = torch.Generator().manual_seed(0)
    population = Population.create(SPEC, 3, evolve=evolve, generator=generator)
    seen = torch.randint(10, (20, 4, 75), generator=generator).float()
    action = torch.randint(2, (20, 4), generator=generator)
    bank = SegmentBank.from_segments(TensorDict({"observation": seen, "action": action}, [20, 4]))
    scores = segment_scores(population, bank, memory_mb=1.0)
    for member in range(3):
        log = population.network(member)(seen.flatten(0, 1)).log_softmax(-1).view(20, 4, 2)
        expected = log.gather(-1, action.unsqueeze(-1)).squeeze(-1).sum(1)
        assert torch.allclose(scores[member], expected, atol=1e-4)


def test_an_environment_of_images_is_learnt_saved_and_acted_in(tmp_path):
    world = make_world(f"{__file__}:Spots")
    config = MethodConfig(hidden=[16], channels=[4])
    spec = build_spec(config, world.env)
    assert (spec.image, spec.image_scale) == ((5, 5, 1), 255.0)
    env = world.make()
    first, _ = env.reset(seed=0)
    images = np.stack([first] + [env.step(0)[0] for _ in range(299)])
    seen = torch.from_numpy(images).unsqueeze(1)
    right = seen.view(300, 5, 5)[:, :, 3:].amax((1, 2)) > 0
    generator = torch.Generator().manual_seed(0)
    action = torch.randint(2, (300, 1), generator=generator)
    bank = SegmentBank.from_segments(TensorDict({"observation": seen, "action": action}, [300, 1]))
    good = (action.squeeze(1) == right.long()).float()
    pair = torch.randint(300, (2000, 2), generator=generator)
    pair = pair[good[pair[:, 0]] != good[pair[:, 1]]]
    answer = (good[pair[:, 1]] > good[pair[:, 0]]).long()
    said = TensorDict({PAIR: pair, ANSWER: answer, RATER: torch.zeros_like(answer)}, [len(pair)])
    comparisons = Comparisons.from_preferences(said, cases="rater")
    population = Population.create(spec, 2, generator=generator)
    loss = CPLLoss(population, bank, alpha=0.5)
    adam = torch.optim.Adam(population.parameters(), lr=1e-2)
    descend(loss, adam, comparisons, steps=80, batch_size=64, generator=generator)
    PolicySet(population, alpha=0.5).save(tmp_path / "set")
    loaded = PolicySet.load(tmp_path / "set")
    acted = loaded.act(seen[:, 0], member=1, greedy=True)
    assert (acted == right.long()).float().mean() > 0.95
    one = loaded.act(seen[3, 0], member=1, greedy=True)  # without a batch
    assert one.shape == ()
    assert one == acted[3]


def test_who_gets_convolutions():
    world = make_world(f"{__file__}:Spots")
    assert build_spec(MethodConfig(), world.env).channels == (16, 32)
    assert build_spec(MethodConfig(channels=[]), world.env).image == ()
    assert build_spec(MethodConfig(evolve="code"), world.env).image == ()
    assert build_spec(MethodConfig(), make_world("two_doors").env).channels == ()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"image": (5, 5, 3), "channels": ()}, "both be given or neither"),
        ({"image": (5, 5, 2)}, "whose product is observation_dim"),
        ({"hidden": ()}, "at least one layer behind convolutions"),
    ],
)
def test_what_is_refused(wrong, message):
    known = {"image": (5, 5, 3), "channels": (4,), "hidden": (16,)}
    with pytest.raises(ValueError, match=message):
        PolicySpec(75, 2, True, **{**known, **wrong})


def test_images_too_small_for_so_many_convolutions():
    with pytest.raises(ValueError, match=r"too small for 3 convolutions.*method\.channels"):
        image_layers((5, 5, 1), (4, 4, 4))
