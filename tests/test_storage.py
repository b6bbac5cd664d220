"""Folders that are written beside their target: whole, or not there."""

import multiprocessing
import os
import signal

import pytest
import torch
from tensordict import TensorDict

from popl_rl.storage import load_tensordict, save_tensordict, written_beside


def test_the_folder_appears_at_the_end_and_alone(tmp_path):
    path = tmp_path / "above" / "set"
    with written_beside(path) as beside:
        (beside / "one").write_text("1")
        (beside / "two").mkdir()
        assert not path.exists()
    assert sorted(entry.name for entry in path.iterdir()) == ["one", "two"]
    assert list(path.parent.iterdir()) == [path]


def test_it_has_the_permissions_of_any_new_folder(tmp_path):
    with written_beside(tmp_path / "set"):
        pass
    (tmp_path / "usual").mkdir()
    assert (tmp_path / "set").stat().st_mode == (tmp_path / "usual").stat().st_mode


def _failing(path, error):
    with written_beside(path) as beside:
        (beside / "one").write_text("1")
        raise error


@pytest.mark.parametrize("error", [OSError("full"), KeyboardInterrupt()])
def test_a_failure_in_the_middle_leaves_nothing(tmp_path, error):
    with pytest.raises(type(error)):
        _failing(tmp_path / "set", error)
    assert list(tmp_path.iterdir()) == []


def _killed_while_writing(path):
    with written_beside(path) as beside:
        (beside / "one").write_text("1")
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_kill_in_the_middle_leaves_nothing_at_the_target(tmp_path):
    path = tmp_path / "set"
    process = multiprocessing.get_context("fork").Process(
        target=_killed_while_writing, args=(path,)
    )
    process.start()
    process.join(30)
    assert process.exitcode == -signal.SIGKILL
    assert not path.exists()
    with written_beside(path) as beside:
        (beside / "two").write_text("2")
    assert [entry.name for entry in path.iterdir()] == ["two"]


def test_what_is_there_is_kept(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "old").write_text("0")
    message = "exists; remove it or choose another path"
    with pytest.raises(FileExistsError, match=message), written_beside(tmp_path / "set"):
        pass
    with pytest.raises(FileExistsError, match=message):
        save_tensordict(TensorDict({"a": torch.ones(2)}, [2]), tmp_path / "set")
    assert [entry.name for entry in (tmp_path / "set").iterdir()] == ["old"]


def test_a_tensordict_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    data = TensorDict({"a": torch.arange(3), "b": {"c": torch.ones(3, 2)}}, [3])
    write = TensorDict.memmap

    def fails(self, *args, **kwargs):
        write(self, *args, **kwargs)
        raise OSError("full")

    with monkeypatch.context() as patch:
        patch.setattr(TensorDict, "memmap", fails)
        with pytest.raises(OSError, match="full"):
            save_tensordict(data, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []
    save_tensordict(data, tmp_path / "set")
    assert (load_tensordict(tmp_path / "set") == data).all()
