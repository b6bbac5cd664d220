"""Comparisons in tables: every way to write an answer, and every way to get one wrong."""

import gzip
import json

import numpy as np
import pandas as pd
import pytest
import torch

from popl_rl.data.readers.opening import guess_reader, open_data
from popl_rl.data.readers.table import read_table

ITEMS = "item,colour,size\na,0.5,1\nb,1.5,2\nc,2.5,3\n"
ANSWERS = (
    "rater,first,second,answer,condition\n"
    "ann,a,b,0,calm\nann,b,c,1,calm\nbo,a,c,2,\n,c,b,3,hurried\nbo,b,a,1,\n"
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "items.csv").write_text(ITEMS)
    (tmp_path / "said.csv").write_text(ANSWERS)
    return tmp_path


def read(folder, text=None, name="said.csv", **options):
    if text is not None:
        (folder / name).write_text(text)
    return read_table(folder / name, items=str(folder / "items.csv"), **options)


def test_a_table_becomes_segments_preferences_and_names(folder):
    found = read(folder)
    assert found.segments["observation"].squeeze(1).tolist() == [[0.5, 1], [1.5, 2], [2.5, 3]]
    assert found.segments["action"].tolist() == [[0], [0], [0]]
    said = found.preferences
    assert said["pair"].tolist() == [[0, 1], [1, 2], [0, 2], [2, 1], [1, 0]]
    assert said["answer"].tolist() == [0, 1, 2, 3, 1]
    assert said["rater"].tolist() == [0, 0, 1, -1, 1]
    assert said["hidden", "condition"].tolist() == [0, 0, -1, 1, -1]
    assert found.names.raters == ["ann", "bo"]
    assert found.names.conditions == ["calm", "hurried"]
    assert found.names.items == ["a", "b", "c"]


@pytest.mark.parametrize("kind", ["csv.gz", "tsv", "jsonl", "jsonl.gz", "parquet"])
def test_other_formats_say_the_same(folder, kind):
    table = pd.read_csv(folder / "said.csv", dtype="string")
    path = folder / f"other.{kind}"
    if kind == "parquet":
        table.to_parquet(path)
    elif "jsonl" in kind:
        table.to_json(path, orient="records", lines=True)
    else:
        table.to_csv(path, index=False, sep="\t" if kind == "tsv" else ",")
    ours, theirs = read(folder), read_table(path, items=str(folder / "items.csv"))
    assert (ours.preferences == theirs.preferences).all()
    assert ours.names == theirs.names


@pytest.mark.parametrize(
    ("words", "answers"),
    [
        (["a", "B", "tie", "skip"], [0, 1, 2, 3]),
        (["first", " second ", "equal", "none"], [0, 1, 2, 3]),
        (["0.0", "1", "2", "3.0"], [0, 1, 2, 3]),
    ],
)
def test_answers_are_words_or_codes(folder, words, answers):
    rows = "".join(f"a,b,{word}\n" for word in words)
    found = read(folder, "first,second,answer\n" + rows)
    assert found.preferences["answer"].tolist() == answers
    assert "rater" not in found.preferences.keys()  # noqa: SIM118 - not a dict
    assert "chance" not in found.preferences.keys()  # noqa: SIM118 - not a dict


def test_fractions_are_soft_labels(folder):
    found = read(folder, "first,second,answer\na,b,0.2\na,c,0.5\nb,c,1\nb,a,skip\n")
    assert found.preferences["answer"].tolist() == [0, 2, 1, 3]
    assert found.preferences["chance"].tolist() == pytest.approx([0.2, 0.5, 1.0, 0.5])


def test_columns_may_have_other_names(folder):
    text = "left,right,choice,worker\na,b,a,7\nb,c,b,007\n"
    options = {"first": "left", "second": "right", "answer": "choice", "rater": "worker"}
    assert read(folder, text, **options).names.raters == ["7", "007"]


HEAD = "rater,first,second,answer\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            HEAD + "x,a,b,0\nx,a,zz,1\nx,qq,b,0\n",
            r"row 3: the column 'second' names an item .*'zz'",
        ),
        (HEAD + "x,a,b,0\nx,a,a,1\n", "row 3: an item is compared with itself"),
        (HEAD + "x,a,b,0\nx,,b,1\n", "row 3: the column 'first' is empty"),
        (HEAD + "x,a,b,maybe\n", r"row 2: the answer is 'maybe'; an answer must be 0 \(first\)"),
        (HEAD + "x,a,b,7\n", "row 2: the answer is '7'"),
        (HEAD + "x,a,b,0.5\nx,a,b,2\n", "row 3: among soft labels, the answer is '2'"),
        (HEAD + "x,a,b,\nx,a,b,0\n", "row 2: the answer is missing"),
        ("first,second\na,b\n", r"must have the columns .* \['answer'\] are missing"),
        (
            "rater,ranking\nx,a>b>c\n",
            "read them by --reader rankings, or data.reader=rankings",
        ),
        (HEAD, "holds no comparisons"),
        (HEAD + "x,a,b,0\n" * 10, "all 10 strict answers prefer the first of the pair"),
    ],
)
def test_what_makes_no_sense_is_refused_with_its_row(folder, text, message):
    with pytest.raises(ValueError, match=message):
        read(folder, text)


def test_all_that_is_wrong_is_told_at_once(folder):
    with pytest.raises(ValueError, match=r"said\.csv cannot be used") as caught:
        read(folder, HEAD + "x,a,a,0\nx,a,zz,1\n" + "x,b,zz,1\n" * 7)
    assert "rows 3, 4, 5, 6, 7 and 3 more" in str(caught.value)
    assert "row 2: an item is compared with itself" in str(caught.value)


def test_one_sided_answers_may_be_meant(folder):
    assert len(read(folder, HEAD + "x,a,b,0\n" * 10, one_sided=True).preferences) == 10


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ("item,size\na,1\nb,2\na,3\n", r"row 4: the id repeats one above \('a'\)"),
        ("item,size\na,1\nb,\nc,nan\n", "rows 3, 4: the column 'size' must hold finite numbers"),
        ("item,size\na,1\n,2\n", "row 3: the id in the column 'item' is missing"),
        ("name,size\na,1\n", "must have a column of ids named item, id, segment"),
        ("item\na\nb\n", "items need numeric columns or a column 'text'"),
        ("item,text\na,hello\nb,\n", "row 3: the column 'text' must hold a text"),
    ],
)
def test_items_that_make_no_sense_are_refused(folder, items, message):
    (folder / "items.csv").write_text(items)
    with pytest.raises(ValueError, match=message):
        read(folder)


def test_another_encoding_is_told_with_its_row(folder):
    (folder / "said.csv").write_bytes(HEAD.encode() + b"x,a,b,0\ncaf\xe9,a,b,1\n")
    with pytest.raises(ValueError, match=r"UTF-8, but row 3 holds the byte 0xe9"):
        read(folder)


def test_a_line_that_is_no_json_is_told_with_its_row(folder):
    with pytest.raises(ValueError, match=r"one JSON object in each line, row 2 is not"):
        read(folder, '{"first": "a", "second": "b", "answer": 0}\n{"first": \n', "said.jsonl")


def test_features_may_lie_in_an_array(folder):
    np.save(folder / "f.npy", np.arange(6.0).reshape(3, 2))
    (folder / "items.csv").write_text("item,text\na,one\nb,two\nc,three\n")
    found = read(folder, features=str(folder / "f.npy"))
    assert found.names.texts == ["one", "two", "three"]
    assert found.segments["observation"][2, 0].tolist() == [4, 5]
    np.save(folder / "f.npy", np.full((3, 2), np.nan))
    with pytest.raises(ValueError, match="rows 0, 1, 2: features must be finite"):
        read(folder, features=str(folder / "f.npy"))


def test_steps_of_segments_of_different_lengths_are_masked(folder):
    steps = "segment,step,action,x,y\ns,1,2,0.1,0\ns,0,1,0.2,0\nt,0,0,0.3,1\n"
    (folder / "steps.csv").write_text(steps)
    (folder / "said.csv").write_text("first,second,answer\ns,t,a\n")
    found = read_table(folder / "said.csv", segments=str(folder / "steps.csv"))
    segments = found.segments
    assert segments["mask"].tolist() == [[True, True], [True, False]]
    assert segments["action"].tolist() == [[1, 2], [0, 0]]
    torch.testing.assert_close(
        segments["observation"][..., 0], torch.tensor([[0.2, 0.1], [0.3, 0.3]])
    )


def test_actions_may_be_vectors(folder):
    (folder / "steps.csv").write_text("segment,action_0,action_1,x\ns,1,2,0\nt,3,4.5,1\n")
    (folder / "said.csv").write_text("first,second,answer\ns,t,a\n")
    found = read_table(folder / "said.csv", segments=str(folder / "steps.csv"))
    assert found.segments["action"].tolist() == [[[1, 2]], [[3, 4.5]]]


def test_what_is_compared_must_be_said_once(folder):
    with pytest.raises(ValueError, match=r"either items=<table or \.npy> or segments="):
        read_table(folder / "said.csv")


def test_the_reader_is_found_by_the_file(folder):
    (folder / "pairs.jsonl").write_text(json.dumps({"chosen": "x", "rejected": "y"}))
    assert guess_reader(folder / "said.csv") == "table"
    assert guess_reader(folder / "pairs.jsonl") == "chosen"
    (folder / "what.xyz").write_text("")
    with pytest.raises(ValueError, match=r"no reader is known for what\.xyz; name one of"):
        guess_reader(folder / "what.xyz")
    with pytest.raises(FileNotFoundError, match="there is no file or folder"):
        guess_reader(folder / "nothing.csv")


def test_options_that_a_reader_does_not_take_are_refused(folder):
    with pytest.raises(TypeError, match=r"reader 'table' does not take nonsense; it takes items"):
        open_data(folder / "said.csv", options={"nonsense": 1})


def test_what_is_no_gzip_is_told(folder):
    (folder / "said.csv.gz").write_text("no")
    with pytest.raises(ValueError, match="is not readable as csv"):
        read(folder, name="said.csv.gz")
    with gzip.open(folder / "said.csv.gz", "wt") as file:
        file.write(ANSWERS)
    assert len(read(folder, name="said.csv.gz").preferences) == 5
