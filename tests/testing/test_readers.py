"""The check of a reader, with a good one and many faulty ones."""

import pytest
import torch
from tensordict import TensorDict

from popl_rl.storage import load_tensordict, save_tensordict
from popl_rl.testing import check_reader, tiny_env


@pytest.fixture
def folder(tmp_path, segments, preferences):
    """Data in a format of somebody's: here two folders of tensors."""
    save_tensordict(segments.select("observation", "action", "info"), tmp_path / "clips")
    save_tensordict(preferences.exclude("hidden"), tmp_path / "answers")
    return tmp_path


def read(path):
    segments = load_tensordict(path / "clips")
    segments.auto_batch_size_(2)
    return segments, load_tensordict(path / "answers")


def changed(part, key, change):
    """The reader with one of its tensors replaced."""

    def other(path):
        segments, preferences = read(path)
        data = (segments, preferences)[part]
        return segments, preferences, data

    def reader(path):
        segments, preferences, data = other(path)
        value = change(data[key].clone())
        del data[key]
        if value is not None:
            data[key] = value
        return segments, preferences

    return reader


def without_an_answer(path):
    return read(path)[0]


def by_hand(path):
    segments, _ = read(path)
    return segments, {"pair": [[0, 1]]}


def without_time(path):
    segments, preferences = read(path)
    return segments.auto_batch_size_(1), preferences


def one_segment(path):
    segments, preferences = read(path)
    return segments[:1], preferences


def as_it_likes(path):
    segments, preferences = read(path)
    return segments[torch.randperm(len(segments))], preferences


BROKEN = {
    "nothing": (lambda _: None, TypeError, r"must return \(segments, preferences\), got a NoneTy"),
    "fails": (lambda path: path["x"], ValueError, "reading .* failed with TypeError"),
    "one": (without_an_answer, TypeError, r"must return \(segments, preferences\), got a TensorD"),
    "dictionary": (by_hand, TypeError, "preferences must be a TensorDict, got a dict"),
    "batch": (without_time, ValueError, r"segments must have the batch size \[N, T\], got \[40\]"),
    "no actions": (
        changed(0, "action", lambda _: None),
        ValueError,
        "segments must hold observation, action, but have no action; they hold",
    ),
    "float64": (
        changed(0, "observation", torch.Tensor.double),
        TypeError,
        "must be float32 .*got torch.float64 of shape .*use .float",
    ),
    "one-hot actions": (
        changed(0, "action", lambda action: torch.eye(2).long()[action]),
        TypeError,
        r"actions must be int64 \[N, T\] or float32 .*got torch.int64 of shape \[40, 4, 2\]",
    ),
    "one segment": (one_segment, ValueError, "at least 2 segments, to compare, got 1"),
    "not finite": (
        changed(0, "observation", lambda value: value / 0),
        ValueError,
        "observation of segments must be finite, got 800 numbers",
    ),
    "no raters": (
        changed(1, "rater", lambda _: None),
        ValueError,
        "preferences must hold pair, answer, rater, but have no rater",
    ),
    "float answers": (
        changed(1, "answer", torch.Tensor.float),
        TypeError,
        r"answer of preferences must be int64 \[M\], got torch.float32",
    ),
    "counts from 1": (
        changed(1, "pair", lambda pair: pair + 40),
        ValueError,
        r"compares segments 4\d\.\.7\d, but there are 0\.\.39",
    ),
    "other answers": (
        changed(1, "answer", lambda answer: answer + 9),
        ValueError,
        r"holds answers outside 0\.\.3",
    ),
    "with itself": (
        changed(1, "pair", lambda pair: pair[:, :1].expand(-1, 2).contiguous()),
        ValueError,
        "two different segments, but 120 compare a segment with itself; leave them out",
    ),
    "ties alone": (
        changed(1, "answer", lambda answer: torch.full_like(answer, 2)),
        ValueError,
        "must hold a strict answer, .*got 120 ties",
    ),
    "random": (as_it_likes, ValueError, "must read the same each time"),
}


@pytest.mark.parametrize(("reader", "error", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_each_fault_of_a_reader_is_found(folder, reader, error, message):
    with pytest.raises(error, match=message):
        check_reader(reader, folder)


def test_a_good_reader_passes(folder):
    check_reader(read, folder)
    check_reader(read, str(folder), tiny_env, max_steps=8)
    with pytest.raises(ValueError, match=r"there is nothing at .*nowhere for reader 'read'"):
        check_reader(read, folder / "nowhere")


def test_data_of_another_environment_are_found(folder):
    with pytest.raises(ValueError, match=r"as the environment's, \[18\] a step, got \[5\]"):
        check_reader(read, folder, "two_doors")
    with pytest.raises(ValueError, match=r"whole numbers 0\.\.1, got .* from 1 to 2"):
        check_reader(changed(0, "action", lambda action: action + 1), folder, tiny_env)


def test_numbers_of_info_are_for_steps(folder):
    def reader(path):
        segments, preferences = read(path)
        wide = TensorDict({"speed": torch.zeros(40, 4, 3)}, [40, 4])
        return segments.set("info", wide), preferences

    with pytest.raises(ValueError, match=r"info 'speed' must be a number for each step, \[40, 4\]"):
        check_reader(reader, folder)
