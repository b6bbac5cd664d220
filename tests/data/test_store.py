import multiprocessing

import pytest
import torch
from tensordict import TensorDict

from popl_rl.data.store import store_path, stored
from popl_rl.storage import load_tensordict

ABOUT = {"env": "tiny", "segments": 3}


def make():
    return TensorDict({"observation": torch.arange(6.0).view(3, 2)}, [3])


def test_other_settings_are_another_folder(tmp_path):
    one = store_path(tmp_path, "metaworld/drawer open", ABOUT)
    assert one.parent == tmp_path
    assert one.name.startswith("metaworld-drawer-open-")
    assert store_path(tmp_path, "metaworld/drawer open", dict(reversed(ABOUT.items()))) == one
    assert store_path(tmp_path, "metaworld/drawer open", {**ABOUT, "segments": 4}) != one


def test_made_once_then_read(tmp_path):
    made = []

    def counted():
        made.append(1)
        return make()

    path = store_path(tmp_path, "tiny", ABOUT)
    first, second = stored(path, ABOUT, counted), stored(path, ABOUT, counted)
    assert first == second == path / "segments"
    assert made == [1]
    assert torch.equal(load_tensordict(first)["observation"], make()["observation"])


def test_an_interrupted_collection_leaves_nothing_and_starts_again(tmp_path):
    path = store_path(tmp_path, "tiny", ABOUT)

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stored(path, ABOUT, interrupted)
    assert not path.exists()
    assert [file.name for file in tmp_path.iterdir()] == [f".{path.name}.lock"]
    assert stored(path, ABOUT, make).is_dir()


def test_a_half_written_or_foreign_folder_is_refused(tmp_path):
    path = store_path(tmp_path, "tiny", ABOUT)
    (path / "segments").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"is not a folder of stored segments.*remove it"):
        stored(path, ABOUT, make)


def test_segments_of_other_settings_are_refused(tmp_path):
    path = tmp_path / "renamed"
    stored(path, ABOUT, make)
    with pytest.raises(ValueError, match="holds segments of other settings"):
        stored(path, {**ABOUT, "segments": 4}, make)


def _store(path):
    stored(path, ABOUT, make)


def test_two_processes_make_it_once(tmp_path):
    path = tmp_path / "shared"
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_store, args=(path,)) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(30)
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert load_tensordict(path / "segments").batch_size == (3,)
