"""npz as CPL publishes it, chosen and rejected texts, Minari, and ours there and back."""

import json

import numpy as np
import pytest
import torch

from popl_rl.data.readers.chosen import read_chosen
from popl_rl.data.readers.items import read_segments
from popl_rl.data.readers.npz import read_npz
from popl_rl.data.readers.summary import summarise
from popl_rl.data.readers.table import read_table
from popl_rl.data.readers.writing import read_folder, write_csv, write_folder, write_npz


def arrays(**more):
    obs = np.arange(4 * 2 * 3, dtype="f4").reshape(4, 2, 3)
    return {"obs": obs, "action": np.zeros((4, 2), "i8"), **more}


def saved(tmp_path, **held):
    np.savez(tmp_path / "data.npz", **held)
    return tmp_path / "data.npz"


def test_pairs_with_answers(tmp_path):
    path = saved(
        tmp_path,
        **arrays(pair=[[0, 1], [3, 2]], answer=[1, 2], rater=[5, -1], condition=["x", "y"]),
    )
    found = read_npz(path)
    assert found.preferences["pair"].tolist() == [[0, 1], [3, 2]]
    assert found.preferences["answer"].tolist() == [1, 2]
    assert found.preferences["rater"].tolist() == [0, -1]
    assert found.names.raters == ["5"]
    assert found.names.conditions == ["x", "y"]


def test_a_number_for_each_segment_compares_consecutive_ones(tmp_path):
    found = read_npz(saved(tmp_path, **arrays(rl_sum=[1.0, 2.0, 3.0, 3.0])))
    assert found.preferences["pair"].tolist() == [[0, 1], [2, 3]]
    assert found.preferences["answer"].tolist() == [1, 2]
    other = read_npz(saved(tmp_path, **arrays(mine=[4.0, 2.0, 3.0, 1.0])), score="mine")
    assert other.preferences["answer"].tolist() == [0, 0]


def test_older_files_hold_both_sides(tmp_path):
    held = arrays()
    path = saved(
        tmp_path,
        obs_1=held["obs"],
        obs_2=held["obs"] + 100,
        action_1=np.zeros((4, 2, 1), "f4"),
        action_2=np.ones((4, 2, 1), "f4"),
        label=np.array([1.0, 0.0, 0.5, 0.9], "f4"),
    )
    found = read_npz(path)
    assert len(found.segments) == 8
    assert found.preferences["pair"].tolist() == [[0, 4], [1, 5], [2, 6], [3, 7]]
    assert found.preferences["answer"].tolist() == [1, 0, 2, 1]
    assert found.preferences["chance"].tolist() == pytest.approx([1, 0, 0.5, 0.9])


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ({"obs": np.zeros((4, 2, 3))}, r"must hold 'action' or 'actions', got \['obs'\]"),
        (arrays(pair=[[0, 9]], answer=[0]), "row 0: 'pair' must name segments in 0..3"),
        (arrays(pair=[[0, 1]], answer=[0, 1]), r"labels must have shape \[1\], got \[2\]"),
        (arrays(pair=[[0, 1]], answer=[0], rater=[1, 2]), r"'rater' must have shape \[1\]"),
        (arrays(pair=[[0, 1]], answer=[0], ranking=[1, 1]), r"'ranking' must have shape \[1\]"),
        (arrays(pair=[[0, 1]], answer=[0], ranking=[0.5]), "'ranking' must be whole numbers, -1"),
        (arrays(obs=np.full((4, 2, 3), np.nan), rl_sum=np.zeros(4)), "rows 0, 1, 2, 3: obs"),
        (arrays(rl_sum=[1, np.inf, 0, 0]), "row 1: the number of a segment must be finite"),
    ],
)
def test_npz_files_that_make_no_sense_are_refused(tmp_path, held, message):
    with pytest.raises(ValueError, match=message):
        read_npz(saved(tmp_path, **held))


def test_chosen_and_rejected_texts(tmp_path):
    lines = [
        {"prompt": "Hi. ", "chosen": "Hi. Good day", "rejected": "No", "objective": "help"},
        {"prompt": "Hi. ", "chosen": "Yes", "rejected": "No", "objective": "harm"},
    ]
    path = tmp_path / "pairs.jsonl"
    path.write_text("\n".join(map(json.dumps, lines)))
    found = read_chosen(path, condition="objective")
    assert found.names.texts == ["Hi. Good day", "Hi. No", "Hi. Yes"]
    # The chosen one stands first, then second.
    assert found.preferences["pair"].tolist() == [[0, 1], [1, 2]]
    assert found.preferences["answer"].tolist() == [0, 1]
    assert found.names.conditions == ["help", "harm"]
    assert found.segments["observation"].shape == (3, 1, 0)


def test_messages_are_joined(tmp_path):
    turns = [{"role": "user", "content": "Hi"}, {"role": "assistant", "content": "Hello"}]
    path = tmp_path / "pairs.jsonl"
    path.write_text(json.dumps({"chosen": turns, "rejected": turns[:1]}))
    assert read_chosen(path).names.texts == ["user: Hi\n\nassistant: Hello", "user: Hi"]


def test_equal_texts_are_refused_or_dropped(tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text("chosen,rejected\nx,y\nz,z\n")
    with pytest.raises(ValueError, match="row 3: both texts are the same"):
        read_chosen(path)
    assert len(read_chosen(path, drop_equal=True).preferences) == 1


@pytest.fixture
def imported(tmp_path):
    (tmp_path / "steps.csv").write_text(
        "segment,action,x,y\ns,1,0.1,0\ns,2,0.2,1\nt,0,0.3,0\nu,1,0.4,1\nu,0,0.5,0\n"
    )
    (tmp_path / "said.csv").write_text(
        "rater,first,second,answer,condition\n"
        "ann,s,t,0.1,c\nann,t,s,0.8,c\nann,s,u,skip,c\nbo,u,s,0.5,d\n,t,s,1,\n"
    )
    return read_table(tmp_path / "said.csv", segments=str(tmp_path / "steps.csv"))


def same(one, other):
    assert (one.preferences == other.preferences).all()
    for key in ("observation", "action", "mask"):
        torch.testing.assert_close(one.segments[key], other.segments[key])


def test_a_folder_of_ours_holds_everything(imported, tmp_path):
    write_folder(imported, tmp_path / "folder")
    found = read_folder(tmp_path / "folder")
    same(found, imported)
    assert found.names == imported.names


def test_csv_there_and_back_keeps_raters(imported, tmp_path):
    write_csv(imported, tmp_path / "out")
    found = read_table(
        tmp_path / "out" / "comparisons.csv", segments=str(tmp_path / "out" / "segments.csv")
    )
    same(found, imported)
    assert found.names == imported.names


def test_npz_there_and_back_keeps_raters(imported, tmp_path):
    write_npz(imported, tmp_path / "out.npz")
    found = read_npz(tmp_path / "out.npz")
    assert (found.preferences == imported.preferences).all()
    assert found.names.raters == ["ann", "bo"]
    assert found.names.conditions == ["c", "d"]
    with pytest.raises(FileExistsError, match="exists; remove it"):
        write_npz(imported, tmp_path / "out.npz")


def test_the_summary_counts_by_hand(imported):
    # ann prefers s to t twice, once shown the other way round: a repeated answer. The third rater
    # of this pair, unknown, prefers s too, so that all three pairs of judgements agree.
    found = summarise(imported)
    assert (found.answers, found.ties, found.skips, found.soft) == (5, 1, 1, 3)
    assert found.raters == {1: 1, 3: 1}
    assert found.unknown == 1
    assert found.conditions == {"c": 3, "d": 1}
    assert (found.shared, found.agreement) == (2, 1.0)
    assert (found.duplicates, found.contradictions) == (1, 0)
    assert found.steps == (1, 2)
    text = "\n".join(found.lines())
    assert "3 segments of 1 to 2 steps, 2 features; 0 never asked about" in text
    assert "2 raters, 2.0 answers each" in text


def test_contradictions_are_counted(tmp_path):
    (tmp_path / "items.csv").write_text("item,x\na,1\nb,2\n")
    (tmp_path / "said.csv").write_text(
        "rater,first,second,answer\nann,a,b,0\nann,b,a,0\nbo,a,b,0\n"
    )
    found = summarise(read_table(tmp_path / "said.csv", items=str(tmp_path / "items.csv")))
    assert (found.duplicates, found.contradictions) == (0, 1)
    assert found.agreement == pytest.approx(1 / 3)


@pytest.mark.filterwarnings("ignore:env_spec is None")
def test_segments_of_a_minari_data_set(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    import gymnasium

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    from minari.data_collector import EpisodeBuffer

    episodes = [
        EpisodeBuffer(
            id=number,
            observations=np.arange(3.0 * (steps + 1), dtype="f4").reshape(-1, 3),
            actions=np.arange(steps),
            rewards=np.ones(steps),
            terminations=np.zeros(steps, bool),
            truncations=np.ones(steps, bool),
        )
        for number, steps in enumerate((4, 3))
    ]
    minari.create_dataset_from_buffers(
        "mine/test-v0",
        episodes,
        eval_env="CartPole-v1",
        observation_space=gymnasium.spaces.Box(-1e3, 1e3, (3,), np.float32),
        action_space=gymnasium.spaces.Discrete(5),
        data_format="hdf5",
        algorithm_name="none",
        author="nobody",
        author_email="nobody@example.org",
        code_permalink="none",
        description="made for a test",
    )
    found = read_segments(tmp_path / "mine" / "test-v0", length=2)
    assert found.segments["action"].tolist() == [[0, 1], [2, 3], [0, 1], [2, 2]]
    assert found.segments["mask"].tolist() == [[True, True]] * 3 + [[True, False]]
    assert found.segments["observation"][1, 0].tolist() == [6, 7, 8]
