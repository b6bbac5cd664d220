"""Folders that are written beside their target: whole, or not there."""

import multiprocessing
import os
import resource
import signal

import pytest
import torch
from tensordict import TensorDict

from popl_rl.storage import load_tensordict, read_manifest, save_tensordict, written_beside


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


SMALL = TensorDict(
    {"a": torch.arange(3), "b": {"c": torch.ones(3, 2), "d": torch.zeros(3, 2)}}, [3]
)


@pytest.mark.parametrize("key", ["a", "b.c"])
def test_a_tensor_that_was_changed_is_named(tmp_path, key):
    save_tensordict(SMALL, tmp_path / "set")
    file = (tmp_path / "set").joinpath(*key.split(".")).with_suffix(".memmap")
    content = bytearray(file.read_bytes())
    content[5] ^= 1
    file.write_bytes(content)
    message = f"was changed or damaged after it was saved: '{key}' is not what manifest.json says"
    with pytest.raises(ValueError, match=message):
        load_tensordict(tmp_path / "set")


def test_tensors_that_were_exchanged_are_refused(tmp_path):
    save_tensordict(SMALL, tmp_path / "set")
    one, other = (tmp_path / "set" / "b" / f"{name}.memmap" for name in "cd")
    one.rename(tmp_path / "aside")
    other.rename(one)
    (tmp_path / "aside").rename(other)
    with pytest.raises(ValueError, match=r"'b\.c', 'b\.d' is not what"):
        load_tensordict(tmp_path / "set")


def test_a_folder_of_an_earlier_version_is_read_with_a_warning(tmp_path):
    save_tensordict(SMALL, tmp_path / "set")
    digest = read_manifest(tmp_path / "set")["digest"]
    (tmp_path / "set" / "manifest.json").unlink()
    assert read_manifest(tmp_path / "set") is None
    with pytest.warns(UserWarning, match="saved by an earlier version, without a manifest"):
        assert (load_tensordict(tmp_path / "set") == SMALL).all()
    assert (load_tensordict(tmp_path / "set", digest=digest) == SMALL).all()
    with pytest.raises(ValueError, match=r"holds other tensors than those that belong here"):
        load_tensordict(tmp_path / "set", digest="0" * 32)


def test_a_manifest_that_was_changed_is_refused(tmp_path):
    save_tensordict(SMALL, tmp_path / "set", about={"segments": "abc"})
    manifest = tmp_path / "set" / "manifest.json"
    assert read_manifest(tmp_path / "set")["about"] == {"segments": "abc"}
    manifest.write_text(manifest.read_text().replace("abc", "abd"))
    with pytest.raises(ValueError, match=r"manifest.json was changed or damaged .* restore the"):
        load_tensordict(tmp_path / "set")
    manifest.write_text(manifest.read_text()[:-9])
    with pytest.raises(ValueError, match=r"manifest.json is damaged, it is no JSON .* restore the"):
        load_tensordict(tmp_path / "set")


def _writes_with_a_limit(path):
    resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, resource.RLIM_INFINITY))
    data = TensorDict({"a": torch.ones(2_000)}, [])
    try:
        save_tensordict(data, path)
    except OSError as error:
        os._exit(7 if "0.0 MB are needed" in str(error) and "resume the run" in str(error) else 8)
    os._exit(9)


def test_where_there_is_no_room_this_is_said_before_anything_is_written(tmp_path):
    """Writing to a memory map would be a segmentation fault on a full disk."""
    process = multiprocessing.get_context("fork").Process(
        target=_writes_with_a_limit, args=(tmp_path / "set",)
    )
    process.start()
    process.join(30)
    assert process.exitcode == 7
    assert list(tmp_path.iterdir()) == []
