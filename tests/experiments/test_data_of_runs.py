import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl.config import (
    DataConfig,
    EnvConfig,
    RatersConfig,
    ResponseConfig,
)
from popl_rl.data.environments import behaviour_shares
from popl_rl.data.segments import collect_segments
from popl_rl.experiments.data import build_groups, build_world, describe, make_data
from popl_rl.keys import ANSWER, GROUP, PAIR, RATER, UTILITY
from popl_rl.models.policies import PolicySpec
from popl_rl.randomness import stream
from popl_rl.raters.groups import make_groups
from popl_rl.storage import save_tensordict


def everything_equal(one, other):
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(
        torch.equal(one[key], other[key]) for key in keys
    )


def test_streams_are_independent_and_reproducible():
    def draw(*arguments):
        return torch.rand(4, generator=stream(*arguments)).tolist()

    assert draw(0, "segments") == draw(0, "segments")
    different = [draw(0, "segments"), draw(1, "segments"), draw(0, "raters"), draw(10, "x")]
    assert len({tuple(values) for values in different}) == 4


def test_a_world_offers_what_its_environment_has(world):
    assert set(world.behaviours) == {"random"}
    assert world.shares == {"random": 1.0}
    assert world.table is not None
    assert world.make().unwrapped is not world.make().unwrapped


WALK = """
import torch
from popl_rl.testing import tiny_env


def go_right(step, generator):
    return torch.ones(step.batch_size, dtype=torch.long)


class Walk(type(tiny_env())):
    def __init__(self, cells="few"):
        super().__init__(8)
        self.cells = cells

    def behaviours(self):
        return {"left": torch.eye(2)[[0] * 5], "right": go_right}
"""


def test_behaviours_are_tables_or_functions(tmp_path, generator):
    (tmp_path / "walk.py").write_text(WALK)
    world = build_world(
        EnvConfig(
            factory=f"{tmp_path}/walk.py:Walk",
            options={"cells": "few"},
            data_options={"cells": "many"},
            mixture={"l*": 0.25, "right": 0.75},
        )
    )
    assert world.make().unwrapped.cells == "few"
    assert world.make_for_data().unwrapped.cells == "many"
    assert world.shares == {"left": 0.25, "right": 0.75}
    step = TensorDict({"info": {"next_state": torch.tensor([0, 4])}}, [2])
    assert world.behaviours["left"](step, generator).tolist() == [0, 0]
    assert world.behaviours["right"](step, generator).tolist() == [1, 1]


def test_gymnasium_environments_need_no_code(generator):
    world = build_world(EnvConfig(factory="gymnasium:make", id="Pendulum-v1"))
    assert world.table is None
    assert set(world.behaviours) == {"random"}
    actions = world.behaviours["random"](TensorDict({}, [300]), generator)
    assert 1.8 < float(actions.abs().max()) <= 2
    assert PolicySpec.from_env(world.env).action_dim == 1


def test_continuous_actions_are_clipped():
    """The mean of a Gaussian policy knows no bounds; Pendulum's are -2 and 2."""

    def after(action):
        env = build_world(EnvConfig(factory="gymnasium:make", id="Pendulum-v1")).make()
        env.reset(seed=0)
        return env.step(np.array([action], dtype=np.float32))[:2]

    observation, reward = after(1e6)
    clipped, same = after(2.0)
    assert observation.tolist() == clipped.tolist()
    assert reward == same


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"factory": "no_such_world"}, "no_such_world"),
        (
            {"factory": "popl_rl.testing:tiny_env", "options": {"colour": "red"}},
            r"env.factory 'popl_rl.testing:tiny_env' cannot be built with id None and options "
            r"\{'colour': 'red'\}: .*unexpected keyword argument",
        ),
        (
            {"factory": "gymnasium:make", "id": "NoSuchWorld-v0"},
            "env.factory 'gymnasium:make' cannot be built with id 'NoSuchWorld-v0'",
        ),
        (
            {"factory": "builtins:dict"},
            r"must return a gymnasium.Env or a TorchRL EnvBase, got <class",
        ),
        (
            {"factory": "popl_rl.testing:tiny_env", "mixture": {"planner/*": 1.0}},
            r"env.mixture 'planner/\*' matches no behaviour; there are random",
        ),
    ],
)
def test_a_world_that_cannot_be_built(config, message):
    with pytest.raises(ValueError, match=message):
        build_world(EnvConfig(**config))


def test_patterns_divide_their_share_equally():
    names = ["planner/a", "planner/b", "explorer", "random"]
    assert behaviour_shares(names, None) == dict.fromkeys(names, 0.25)
    shares = behaviour_shares(names, {"planner/*": 0.5, "*r": 0.5})
    assert shares == {"planner/a": 0.25, "planner/b": 0.25, "explorer": 0.5, "random": 0.0}
    both = behaviour_shares(names, {"planner/*": 0.5, "planner/a": 0.5})
    assert both["planner/a"] == 0.75


def test_groups_answer_as_configured(world, asked):
    response = ResponseConfig(rationality=2.0, mistake=0.1, myopia=0.9, tie=0.2, skip=0.3)
    for label in ("regret", "return"):
        config = RatersConfig(groups=asked.groups, label=label, response=response)
        groups = build_groups(config, world)
        assert [group.name for group in groups] == ["likes_left", "likes_right"]
        for group in groups:
            assert group.label == label
            assert vars(group.response) == vars(response)


def test_without_a_table_regret_waits_for_values_fitted_to_the_data():
    config = EnvConfig(factory="gymnasium:make", id="CartPole-v1", max_steps=50)
    world = build_world(config)
    group = make_groups([lambda segments: -segments["observation"][..., 0].abs()], label="return")
    data = DataConfig(segments=40, length=6)
    plain, fitted = (
        make_data(data, RatersConfig(label=label, count=4), world, group, seed=0, env=config)
        for label in ("return", "regret")
    )
    assert torch.equal(plain.steps["observation"], fitted.steps["observation"])
    assert not torch.equal(plain.segment_utility, fitted.segment_utility)
    assert fitted.segment_utility.isfinite().all()


def test_stored_segments_are_collected_once_and_linked(
    world, tiny_groups, tmp_path, monkeypatch, collect
):
    collected = []

    def counting(*arguments, **options):
        collected.append(options["num_segments"])
        return collect_segments(*arguments, **options)

    monkeypatch.setattr("popl_rl.experiments.data.collect_segments", counting)
    store = str(tmp_path / "store")
    one = collect(world, tiny_groups, store=store)
    again = collect(world, tiny_groups, store=store)
    assert collected == [30]
    assert everything_equal(one.steps, again.steps)
    other = collect(world, tiny_groups, store=store, segments=32)
    assert collected == [30, 32]
    assert other.store != one.store

    one.save(tmp_path / "run" / "data")
    assert (tmp_path / "run" / "data" / "segments").is_symlink()
    loaded = collect(world, tiny_groups, load=tmp_path / "run" / "data")
    assert everything_equal(loaded.steps, one.steps)
    assert everything_equal(loaded.preferences, one.preferences)
    assert loaded.store == one.store


def test_a_seed_of_the_data_makes_runs_share_segments_but_not_answers(world, tiny_groups, asked):
    data = DataConfig(segments=30, length=4, seed=7)
    one, other = (
        make_data(data, asked, world, tiny_groups, seed=seed, env=EnvConfig(max_steps=8))
        for seed in (0, 1)
    )
    assert everything_equal(one.steps, other.steps)
    assert not everything_equal(one.preferences, other.preferences)


def test_data_are_reproducible_and_saved_data_come_back(world, tiny_groups, tmp_path, collect):
    data = collect(world, tiny_groups)
    assert data.steps.batch_size == (30, 4)
    assert set(data.preferences.keys(True, True)) == {PAIR, ANSWER, RATER, GROUP, UTILITY}
    assert data.preferences[RATER].bincount().tolist() == [10] * 6
    expected = torch.stack([group.segment_utility(data.steps) for group in tiny_groups])
    assert torch.equal(data.segment_utility, expected)

    again, other = collect(world, tiny_groups), collect(world, tiny_groups, seed=1)
    assert everything_equal(data.steps, again.steps)
    assert everything_equal(data.preferences, again.preferences)
    assert not everything_equal(data.preferences, other.preferences)

    data.save(tmp_path)
    loaded = collect(world, tiny_groups, seed=5, load=tmp_path)
    assert everything_equal(loaded.steps, data.steps)
    assert everything_equal(loaded.preferences, data.preferences)
    assert torch.equal(loaded.segment_utility, data.segment_utility)


def test_saving_again_replaces_nothing(world, tiny_groups, tmp_path, collect):
    data = collect(world, tiny_groups)
    data.save(tmp_path)
    collect(world, tiny_groups, seed=1).save(tmp_path)
    assert everything_equal(collect(world, tiny_groups, load=tmp_path).steps, data.steps)


def test_asking_more_raters_leaves_the_segments_alone(world, tiny_groups, asked):
    more = RatersConfig(groups=asked.groups, count=9, answers=3)
    data = DataConfig(segments=30, length=4)
    one = make_data(data, asked, world, tiny_groups, seed=0, env=EnvConfig(max_steps=8))
    other = make_data(data, more, world, tiny_groups, seed=0, env=EnvConfig(max_steps=8))
    assert everything_equal(one.steps, other.steps)


def test_segments_may_be_memory_mapped(world, tiny_groups, tmp_path, collect):
    mapped = collect(world, tiny_groups, memmap=str(tmp_path / "map"))
    assert list((tmp_path / "map").rglob("*.memmap"))
    in_memory = collect(world, tiny_groups)
    assert everything_equal(mapped.steps, in_memory.steps)
    assert everything_equal(mapped.preferences, in_memory.preferences)


def test_progress_is_told(world, tiny_groups, asked):
    told = []
    data, env = DataConfig(segments=30, length=4), EnvConfig(max_steps=8)
    make_data(data, asked, world, tiny_groups, seed=0, env=env, progress=told.append)
    assert told[-1] == 30


def test_too_little_data_are_refused(world, tiny_groups, tmp_path, collect):
    collect(world, tiny_groups).save(tmp_path)
    message = "data.segments asks for 31 segments, but .* holds 30; ask for fewer or collect more"
    with pytest.raises(ValueError, match=message):
        collect(world, tiny_groups, load=tmp_path, segments=31)


def test_data_of_another_environment_are_refused(world, tiny_groups, tmp_path, collect):
    collect(world, tiny_groups).save(tmp_path)
    other = build_world(EnvConfig(factory="gymnasium:make", id="CartPole-v1"))
    message = r"holds observations of shape \(5,\), but the environment gives \(4,\)"
    with pytest.raises(ValueError, match=message):
        collect(other, tiny_groups, load=tmp_path)


def test_data_of_more_groups_are_refused(world, tiny_groups, tmp_path, collect):
    collect(world, tiny_groups).save(tmp_path)
    message = "holds preferences of 2 groups, but raters.groups names 1; name the groups that were"
    with pytest.raises(ValueError, match=message):
        collect(world, tiny_groups[:1], load=tmp_path)


def test_foreign_data_are_refused(world, tiny_groups, tmp_path, collect):
    save_tensordict(TensorDict({"observation": torch.zeros(30, 4, 5)}, [30]), tmp_path / "segments")
    with pytest.raises(ValueError, match="does not hold what was expected: 'action'"):
        collect(world, tiny_groups, load=tmp_path)


def test_segments_of_a_world_whose_file_has_changed_are_collected_again(tmp_path):
    (tmp_path / "walk.py").write_text(WALK)
    env, data = EnvConfig(factory=f"{tmp_path}/walk.py:Walk"), DataConfig()
    before = describe(env, data, seed=0)
    assert describe(env, data, seed=0) == before
    (tmp_path / "walk.py").write_text(WALK + "# changed")
    assert describe(env, data, seed=0) != before
    assert "plug_ins" not in describe(EnvConfig(), data, seed=0)
