"""What raters are asked in training, and what nobody is asked before the evaluation."""

import dataclasses

import pytest
import torch

from popl_rl.config import (
    Config,
    DataConfig,
    EnvConfig,
    EvaluationConfig,
    MethodConfig,
    RatersConfig,
)
from popl_rl.data.environments import build_world
from popl_rl.experiments.builders import build_spec
from popl_rl.experiments.data import build_groups, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.keys import PAIR

ENV = EnvConfig(factory="popl_rl.testing:tiny_env", max_steps=8)
LEFT_RIGHT = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]
RATERS = RatersConfig(groups=LEFT_RIGHT, count=12, answers=20, label="return")
DATA = DataConfig(segments=80, length=4)


@pytest.fixture
def world():
    return build_world(ENV)


@pytest.fixture
def groups(world):
    return build_groups(RATERS, world)


def with_starts(world, segments):
    """The world, which gives these segments: four from each state, as it says."""
    start = torch.arange(len(segments) // 4).repeat_interleave(4)
    segments = segments.clone()
    segments["info", "start"] = start.unsqueeze(-1).expand(segments.shape).clone()

    def collect(num_segments, length, *, generator, progress=None):
        return segments[:num_segments]

    return dataclasses.replace(world, collect=collect)


def evaluator_of(world, groups, data):
    config = Config(
        env=ENV,
        raters=RATERS,
        data=DATA,
        method=MethodConfig(hidden=[8]),
        evaluation=EvaluationConfig(episodes=2, new_raters=3, answers=10, curve=[], pairs=500),
    )
    spec = build_spec(config.method, world.env)
    return make_evaluator(config, world, groups, data, spec, seed=0)


def asked_in_evaluation(evaluator):
    """All pairs that an evaluation is about, ``[M, 2]``."""
    held_out = [torch.stack(pair, -1) for pair in evaluator.pairs.values()]
    new = [said[PAIR] for raters in evaluator.new_raters for said in raters]
    return torch.cat([*held_out, *new, *(panel[PAIR] for panel in evaluator.held_out)])


def unordered(pairs):
    return {frozenset(pair) for pair in pairs.tolist()}


def test_no_pair_of_training_is_asked_again(world, groups):
    data = make_data(DATA, RATERS, world, groups, seed=0, env=ENV)
    again = asked_in_evaluation(evaluator_of(world, groups, data))
    assert len(unordered(data.preferences[PAIR]) & unordered(again)) == 0


def test_no_segment_of_training_is_shown_again_where_segments_have_starts(world, groups):
    walks = make_data(DATA, RATERS, world, groups, seed=0, env=ENV).steps
    world = with_starts(world, walks)
    data = make_data(DATA, RATERS, world, groups, seed=0, env=ENV)
    asked = data.preferences[PAIR]
    again = asked_in_evaluation(evaluator_of(world, groups, data))
    assert torch.equal(again[:, 0] // 4, again[:, 1] // 4)
    # 240 queries find all 96 pairs of the 16 starts that there are for training.
    assert set((asked // 4).flatten().tolist()) == set(range(16))
    assert set((again // 4).flatten().tolist()) == set(range(16, 20))
    assert len(unordered(asked) & unordered(again)) == 0
