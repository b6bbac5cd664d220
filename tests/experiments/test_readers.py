"""Other people's data, by a reader of one's own: one function in a file."""

import math

import numpy as np
import pytest

from popl_rl.trainers import evaluate_policies
from popl_rl.trainers.train_popl import run

READER = """
import numpy as np
import torch
from tensordict import TensorDict


def read(path):
    data = {name: torch.from_numpy(value) for name, value in np.load(path).items()}
    count, length = data["action"].shape
    steps = {name: data[name] for name in ("observation", "action")}
    segments = TensorDict({**steps, "info": {"next_state": data["after"]}}, [count, length])
    asked = {name: data[name] for name in ("pair", "answer", "rater")}
    return segments, TensorDict(asked, [len(data["pair"])])
"""


@pytest.fixture
def theirs(tmp_path, segments, preferences):
    """A reader, and an npz file that it reads."""
    (tmp_path / "mine.py").write_text(READER)
    columns = {name: segments[name].numpy() for name in ("observation", "action")}
    columns["after"] = segments["info", "next_state"].numpy()
    columns |= {name: preferences[name].numpy() for name in ("pair", "answer", "rater")}
    np.savez(tmp_path / "theirs.npz", **columns)
    return [
        "env=custom",
        "env.factory=popl_rl.testing:tiny_env",
        "env.max_steps=8",
        "raters.groups=['popl_rl.testing:likes_left','popl_rl.testing:likes_right']",
        "raters.label=return",
        "data.segments=40",
        "data.length=4",
        "evaluation.baselines=false",
        f"data.reader={tmp_path}/mine.py:read",
        f"data.load={tmp_path}/theirs.npz",
    ]


def test_a_run_trains_on_what_a_reader_reads(config_of, tiny, theirs, tmp_path, segments):
    result = run(config_of(*tiny[1:], *theirs, f"run_dir={tmp_path / 'run'}"))
    assert math.isfinite(result.board.value("popl", "likes_left", "return"))
    # Kept in our own format, which the next run can load without the reader.
    again = [f"data.load={tmp_path}/run/data", "data.reader=null", f"run_dir={tmp_path}/again"]
    other = run(config_of(*tiny[1:], *theirs, *again))
    assert other.board.results.equals(result.board.results)


def test_data_that_were_not_kept_are_read_again_to_evaluate(config_of, tiny, theirs, tmp_path):
    folder = f"run_dir={tmp_path / 'run'}"
    first = run(config_of(*tiny[1:], *theirs, "data.save=false", folder))
    again = config_of(folder, "seed=0", name="evaluate")
    _, board = evaluate_policies.run(again)
    assert board.results.equals(first.board.results)


def test_what_refers_to_segments_that_do_not_exist_is_refused(config_of, tiny, theirs, tmp_path):
    data = dict(np.load(tmp_path / "theirs.npz"))
    data["pair"] = data["pair"] + 20
    np.savez(tmp_path / "theirs.npz", **data)
    with pytest.raises(ValueError, match=r"theirs.npz compares segments \d+\.\.\d+, but there are"):
        run(config_of(*tiny[1:], *theirs, f"run_dir={tmp_path / 'run'}"))
