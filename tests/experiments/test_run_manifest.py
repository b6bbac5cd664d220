"""A run's settings, plug-ins and data are those it was started with, or it says what is not."""

import shutil

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from popl_rl.config import Config, RatersConfig
from popl_rl.experiments.run_folder import create_run_dir, save_config
from popl_rl.experiments.run_manifest import (
    check_own,
    check_own_data,
    config_text,
    is_run_of,
    load_run_config,
    run_id,
    write_run_manifest,
)
from popl_rl.registry import resolve
from popl_rl.storage import save_tensordict

RATERS = """
from shared import SCALE

def likes(segments, scale=1):
    return SCALE * scale * segments["reward"]
"""


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    """A folder with a rater in a file, which imports another one."""
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "raters_of_mine.py").write_text(RATERS)
    (folder / "shared.py").write_text("SCALE = 2\n")
    (folder / "unrelated.py").write_text("")
    monkeypatch.chdir(folder)
    return folder


CONFIG = {"seed": 3, "raters": {"groups": ["raters_of_mine.py:likes(3)", "upper"]}}


def begin(run_dir, config=CONFIG):
    run_dir.mkdir()
    write_run_manifest(run_dir, config)
    save_config(run_dir, config)
    return run_dir


def test_settings_come_back_as_they_were(tmp_path, plug_in):
    run = begin(tmp_path / "run")
    assert load_run_config(run) == CONFIG
    assert run_id(run) != run_id(begin(tmp_path / "other"))
    assert is_run_of(run, CONFIG)
    assert not is_run_of(run, {**CONFIG, "seed": 4})
    assert not is_run_of(tmp_path, CONFIG)


def test_settings_may_be_a_dataclass(tmp_path, plug_in):
    raters = RatersConfig(groups=["raters_of_mine.py:likes(3)", "upper"])
    run = begin(tmp_path / "run", Config(raters=raters))
    assert (run / "plug_ins" / "0" / "shared.py").is_file()
    assert load_run_config(run).raters.groups == raters.groups


def test_settings_that_were_changed_are_refused(tmp_path, plug_in):
    run = begin(tmp_path / "run")
    (run / "config.yaml").write_text(config_text({**CONFIG, "seed": 4}))
    with pytest.raises(ValueError, match=r"config\.yaml was changed .* start another run"):
        load_run_config(run)


def test_a_folder_of_an_earlier_version_is_read_as_it_is(tmp_path, plug_in):
    run = begin(tmp_path / "run")
    (run / "manifest.json").unlink()
    assert run_id(run) is None
    assert load_run_config(run) == CONFIG
    check_own(run, {}, run / "policies")


def test_plug_ins_are_found_from_any_folder(tmp_path, plug_in, monkeypatch):
    run = begin(tmp_path / "run")
    kept = sorted(path.name for path in (run / "plug_ins" / "0").iterdir())
    assert kept == ["raters_of_mine.py", "shared.py"]
    monkeypatch.chdir(tmp_path)
    found, upper = load_run_config(run).raters.groups
    assert upper == "upper"
    segments = TensorDict({"reward": torch.ones(2, 3)}, [2, 3])
    assert torch.equal(resolve("rater", found)(segments), torch.full((2, 3), 6.0))


@pytest.mark.parametrize("changed", ["raters_of_mine.py", "shared.py"])
def test_a_plug_in_that_has_changed_is_used_as_it_was(tmp_path, plug_in, changed):
    run = begin(tmp_path / "run")
    with (plug_in / changed).open("a") as file:
        file.write("# changed\n")
    with pytest.warns(UserWarning, match="has changed since the run .* whose own copy is used"):
        config = load_run_config(run)
    assert config.raters.groups[0] == f"{run}/plug_ins/0/raters_of_mine.py:likes(3)"
    (run / "plug_ins" / "0" / changed).write_text("changed too")
    with pytest.raises(ValueError, match=rf"{changed}, the run's own copy of a"):
        load_run_config(run)


def test_what_is_another_runs_is_refused(tmp_path, plug_in):
    one, other = begin(tmp_path / "one"), begin(tmp_path / "other")
    data = TensorDict({"pair": torch.tensor([[0, 1]])}, [1])
    save_tensordict(data, one / "data" / "preferences", about={"run": run_id(one)})
    check_own_data(one)
    shutil.copytree(one / "data", other / "data")
    with pytest.raises(ValueError, match=r"is of run .*: something was exchanged"):
        check_own_data(other)
    check_own(one, {"run": run_id(one)}, one / "policies")
    with pytest.raises(ValueError, match=r"policies is of run unknown, but "):
        check_own(one, {}, one / "policies")


def test_a_run_that_was_killed_at_once_does_not_stand_in_the_way(tmp_path, plug_in):
    run = begin(tmp_path / "run")
    with pytest.raises(FileExistsError, match="is not empty"):
        create_run_dir(run, name="popl")
    (run / "config.yaml").unlink()
    (run / ".lock").touch()
    assert create_run_dir(run, name="popl") == run
    write_run_manifest(run, OmegaConf.create(CONFIG))
    save_config(run, CONFIG)
    assert load_run_config(run) == CONFIG
