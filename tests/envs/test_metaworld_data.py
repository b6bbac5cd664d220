"""Segments of Metaworld's tasks, up to a whole run."""

from functools import partial

import numpy as np
import pytest
import torch

from popl_rl.data.segments import collect_segments
from popl_rl.envs._metaworld_data import collect_continuations
from popl_rl.envs.metaworld_tasks import MetaworldTask, metaworld
from popl_rl.models.policy_set import PolicySet
from popl_rl.raters.values import fit_value
from popl_rl.trainers.train_popl import run


def test_behaviours_give_segments():
    env = metaworld("plate-slide").unwrapped
    behaviours = env.behaviours()
    assert {name.split("/")[0] for name in behaviours} == {"scripted", "rough"}
    chosen = {name: behaviours[name] for name in ("scripted/0.25", "rough/0.8")}
    segments = collect_segments(
        lambda: metaworld("plate-slide"),
        chosen,
        num_segments=6,
        length=10,
        max_steps=20,
        num_envs=2,
        generator=torch.Generator().manual_seed(0),
    )
    assert segments.batch_size == (6, 10)
    assert segments["action"].abs().max() <= 1


def test_continuations_begin_alike():
    env = MetaworldTask("button-press")
    generator = torch.Generator().manual_seed(0)
    counts = []
    segments = collect_continuations(
        env, starts=3, per_start=2, length=12, generator=generator, progress=counts.append
    )
    assert segments.batch_size == (6, 12)
    assert segments["info", "start"][:, 0].tolist() == [0, 0, 1, 1, 2, 2]
    first = segments["observation"][:, 0]
    assert torch.equal(first[0::2], first[1::2])
    assert not torch.equal(first[0], first[2])
    assert not torch.equal(segments["action"][0], segments["action"][1])
    assert counts == [2, 4, 6]
    with pytest.raises(ValueError, match="per_start must be 1 to 4"):
        collect_continuations(env, starts=1, per_start=9, generator=generator)
    with pytest.raises(ValueError, match="length must be at least 1"):
        collect_continuations(env, starts=1, length=0, generator=generator)


@pytest.mark.parametrize("task", ["drawer-open", "pick-place"])  # whose states look elsewhere
def test_workers_collect_the_same(task, workers):
    found = []
    for where in (None, workers):
        counts, generator = [], torch.Generator().manual_seed(1)
        segments = collect_continuations(
            MetaworldTask(task, terminate=False),
            starts=3,
            per_start=2,
            length=12,
            starts_per_episode=2,
            generator=generator,
            progress=counts.append,
            workers=where,
        )
        assert counts == [2, 4, 6]
        found.append((segments, generator.get_state()))
    (alone, state), (together, other) = found
    assert set(alone.keys(True, True)) == set(together.keys(True, True))
    assert bool((alone == together).all())
    assert torch.equal(state, other)


def test_a_number_of_segments_that_is_no_multiple_of_the_speeds_is_refused():
    generator = torch.Generator().manual_seed(0)
    with pytest.raises(ValueError, match=r"multiple of the scripted speeds.*got 30 segments and 4"):
        MetaworldTask().collect_segments(30, 8, generator=generator)
    with pytest.raises(ValueError, match="got 4 segments and 1 speeds"):
        MetaworldTask(speeds=[0.5]).collect_segments(4, 8, generator=generator)


def test_a_run_from_segments_to_animations(config_of, tmp_path, monkeypatch):
    """One tiny run: style codes, one set of segments for two runs, motion and its pictures."""
    picture = np.zeros((8, 8, 3), np.uint8)
    monkeypatch.setattr(
        MetaworldTask, "render", lambda env: picture + np.uint8(env.get_state().time % 250)
    )
    monkeypatch.setattr("popl_rl.envs._metaworld_task.check_scripted", lambda *_, **__: {})
    monkeypatch.setattr("popl_rl.raters.values.fit_value", partial(fit_value, steps=5))
    overrides = (
        "env=metaworld/button_press",
        "env.max_steps=90",
        f"data.store={tmp_path / 'store'}",
        "data.segments=24",
        "evaluation.pairs=12",
        "data.length=20",
        "raters.count=8",
        "raters.answers=5",
        "method.hidden=[16,16]",
        "method.clone.steps=60",
        "method.members=4",
        "method.generations=2",
        "method.training.steps=10",
        "method.popl.pooled_steps=3",
        "method.popl.specialist_steps=2",
        "evaluation.episodes=2",
        "evaluation.new_raters=2",
        "evaluation.answers=5",
        "evaluation.learning_curve=0",
        "logger=csv",
    )
    result = run(config_of(*overrides, f"run_dir={tmp_path / 'run'}"))
    table = result.board.results
    assert {"fast", "gentle"} <= set(table.group)
    assert {"popl", "pooled_cpl", "oracle", "clone", "random"} <= set(table.method)
    assert table[table.measure == "return"].value.notna().all()
    speeds = table[table.measure.isin(["mean_hand_speed", "peak_hand_speed"])]
    assert len(speeds) >= 20
    assert (speeds.value > 0).all()
    # A recovery of 0 is what the oracle of the other group is worth.
    for group in ("fast", "gentle"):
        value, best = (result.board.value(who, group, "return") for who in ("clone", "oracle"))
        recovered = result.board.value("clone", group, "recovery")
        assert np.isnan(recovered) or (recovered < 1) == (value < best)
    drawn = {path.name for path in (tmp_path / "run" / "figures").iterdir()}
    assert {"plane.png", "profiles.png", "fast.gif", "gentle.gif"} <= drawn
    loaded = PolicySet.load(tmp_path / "run" / "policies")
    seen = torch.rand(3, 39, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(loaded.act(seen), result.policies.act(seen), atol=1e-4)

    (store,) = (tmp_path / "store").glob("metaworld-button-press-*")
    kept = [path for path in store.rglob("*") if path.is_file() and path.suffix != ".lock"]
    before = {path: path.stat().st_mtime_ns for path in kept}
    undrawn = ("evaluation.figures=false", f"run_dir={tmp_path / 'again'}")
    again = run(config_of(*overrides, *undrawn))
    assert again.board.results.equals(table)
    assert {path: path.stat().st_mtime_ns for path in kept} == before
