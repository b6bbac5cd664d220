"""What raters are asked in training, and what nobody is asked before the evaluation."""

import dataclasses
import json
import shutil

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
from popl_rl.experiments.builders import build_spec
from popl_rl.experiments.data import build_groups, build_world, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.keys import GROUP, PAIR
from popl_rl.storage import save_tensordict

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

    def collect(num_segments, length, *, generator, progress=None, workers=None):
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


def test_more_held_out_pairs_than_there_are_is_said(world, groups):
    """Of 20 segments 190 pairs, less the 12 raters' 20 answers, which are at least 100 of them."""
    few = dataclasses.replace(DATA, segments=20)
    data = make_data(few, RATERS, world, groups, seed=0, env=ENV)
    asked = len(unordered(data.preferences[PAIR]))
    said = f"asks for 500 held-out pairs, but the data have {190 - asked}: pairs repeat"
    with pytest.warns(UserWarning, match=said):
        evaluator_of(world, groups, data)


def test_no_pair_of_training_is_asked_again(world, groups):
    data = make_data(DATA, RATERS, world, groups, seed=0, env=ENV)
    again = asked_in_evaluation(evaluator_of(world, groups, data))
    assert len(unordered(data.preferences[PAIR]) & unordered(again)) == 0


def test_no_segment_of_training_is_shown_again_where_segments_have_starts(world, groups):
    walks = make_data(DATA, RATERS, world, groups, seed=0, env=ENV).steps
    world = with_starts(world, walks)
    data = make_data(DATA, RATERS, world, groups, seed=0, env=ENV)
    asked = data.preferences[PAIR]
    # Of the four starts that are kept, six pairs each.
    with pytest.warns(UserWarning, match="but the data have 24: pairs repeat"):
        evaluator = evaluator_of(world, groups, data)
    again = asked_in_evaluation(evaluator)
    assert torch.equal(again[:, 0] // 4, again[:, 1] // 4)
    # 240 queries find all 96 pairs of the 16 starts that there are for training.
    assert set((asked // 4).flatten().tolist()) == set(range(16))
    assert set((again // 4).flatten().tolist()) == set(range(16, 20))
    assert len(unordered(asked) & unordered(again)) == 0


def asking(*names):
    references = [f"popl_rl.testing:{name}" for name in names]
    return dataclasses.replace(RATERS, groups=references)


@pytest.fixture
def saved(world, groups, tmp_path):
    make_data(DATA, RATERS, world, groups, seed=0, env=ENV).save(tmp_path / "data")
    return tmp_path / "data"


def load(world, raters, folder):
    groups = build_groups(raters, world)
    return make_data(DATA, raters, world, groups, seed=0, env=ENV, load=folder)


def test_the_groups_that_were_asked_are_kept_by_name(world, saved, tmp_path):
    assert json.loads((saved / "about.json").read_text())["groups"] == ["likes_left", "likes_right"]
    load(world, RATERS, saved).save(tmp_path / "again")
    assert load(world, RATERS, tmp_path / "again").groups == ("likes_left", "likes_right")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["likes_right", "likes_left"], "another order or by other names; .* in that order: "),
        (["likes_left", "likes_nothing"], "another order or by other names"),
        (["likes_left"], "of 2 groups, but raters.groups names 1"),
        (["likes_left", "likes_right", "likes_nothing"], "of 2 groups, but .* names 3"),
    ],
)
def test_data_of_other_groups_are_refused(world, saved, names, message, monkeypatch):
    monkeypatch.setattr(
        "popl_rl.testing.likes_nothing", lambda steps: torch.zeros(steps.shape), raising=False
    )
    both = rf"expected \[likes_left, likes_right\], got \[{', '.join(names)}\]"
    with pytest.raises(ValueError, match=f"{message}.*{both}"):
        load(world, asking(*names), saved)


@pytest.mark.parametrize("text", [None, "not json", "[]", "{}", '{"groups": 3}'])
def test_data_whose_groups_are_unknown_are_refused_with_a_cure(world, saved, text):
    (saved / "about.json").unlink()
    if text is not None:
        (saved / "about.json").write_text(text)
    with pytest.raises(
        ValueError, match=r"Collect the data again, or, .* write it yourself"
    ) as told:
        load(world, RATERS, saved)
    (saved / "about.json").write_text(str(told.value).rpartition("yourself: ")[2])
    load(world, RATERS, saved)


def test_preferences_of_people_name_no_groups(world, groups, tmp_path):
    data = make_data(DATA, RATERS, world, groups, seed=0, env=ENV)
    people = data.preferences.exclude(GROUP)
    save_tensordict(data.steps, tmp_path / "segments")
    save_tensordict(people, tmp_path / "preferences")
    load(world, asking("likes_right", "likes_left"), tmp_path).save(tmp_path / "again")
    assert not (tmp_path / "again" / "about.json").exists()


def test_names_of_fewer_groups_than_answered_are_refused(world, saved):
    (saved / "about.json").write_text('{"groups": ["likes_left"]}')
    with pytest.raises(ValueError, match=r"of 2 groups, but .*about\.json names 1; the two do not"):
        load(world, RATERS, saved)


def test_names_that_were_exchanged_beside_the_answers_are_refused(world, saved):
    (saved / "about.json").write_text('{"groups": ["likes_right", "likes_left"]}')
    with pytest.raises(ValueError, match=r"but the raters in .* are of \[likes_left, "):
        load(world, asking("likes_right", "likes_left"), saved)


def test_a_rater_that_was_changed_since_is_not_judged_by_its_old_answers(world, saved, monkeypatch):
    monkeypatch.setattr(
        "popl_rl.testing.likes_left", lambda steps: torch.zeros(steps.shape), raising=False
    )
    with pytest.raises(ValueError, match="what likes_left want is not what they wanted"):
        load(world, asking("likes_left", "likes_right"), saved)


def test_segments_of_another_run_under_these_preferences_are_refused(world, groups, saved):
    make_data(DATA, RATERS, world, groups, seed=1, env=ENV).save(saved / "other")
    shutil.rmtree(saved / "segments")
    (saved / "other" / "segments").rename(saved / "segments")
    with pytest.raises(ValueError, match="compares other segments than those beside it"):
        load(world, RATERS, saved)


def test_data_of_another_length_are_refused(world, groups, saved):
    longer = dataclasses.replace(DATA, length=DATA.length + 1)
    with pytest.raises(ValueError, match=f"set data.length={DATA.length}, or collect others"):
        make_data(longer, RATERS, world, groups, seed=0, env=ENV, load=saved)
