"""Studies, each one command, on small data of the same formats."""

import gzip
import json

import numpy as np
import pandas as pd
import pytest

from popl_rl.envs.delivery import DeliveryGrid
from popl_rl.experiments.delivery_study import exact_returns, led_to
from popl_rl.experiments.tables import COLUMNS
from popl_rl.trainers import run_study

SHORT = [
    "method.members=4",
    "method.generations=3",
    "method.training.steps=60",
    "method.training.batch_size=64",
    "method.refinement.steps=30",
    "people.methods=[popl]",
    "people.folds=2",
    "people.repeats=1",
    "people.curve=[0,5]",
]


@pytest.mark.slow
def test_a_study_of_the_delivery_grid(tmp_path, capsys):
    """16 people, half of whom look at what is collected, half at whether the goal is neared."""
    grid, rng = DeliveryGrid(), np.random.default_rng(0)
    reward = grid.step_reward.reshape(16, 4)
    away = np.array([abs(cell // 4) + abs(3 - cell % 4) for cell in range(16)])
    start = rng.choice(np.flatnonzero(grid.open), (16 * 24, 2))
    action = rng.integers(4, size=(16 * 24, 2, 1))
    place = np.stack(np.divmod(start, 4), -1)
    cell, _ = grid.walk(place.reshape(-1, 2), action.reshape(-1, 1))
    cell = cell.reshape(-1, 2)
    after = np.array(
        [
            [
                [grid.walk(p[None], np.array([[a, 0]]))[0][0, 1]]
                for p, a in zip(pair, acts[:, 0], strict=True)
            ]
            for pair, acts in zip(place, action, strict=True)
        ]
    )[..., 0]
    collected, neared = reward[cell, action[..., 0]], away[cell] - away[after]
    person = np.repeat(np.arange(16), 24)
    value = np.where((person % 2 == 0)[:, None], collected, neared)
    answer = np.where(value[:, 0] == value[:, 1], 2, value.argmax(1))
    np.savez(
        tmp_path / "delivery.npz",
        board=grid.board,
        start=place,
        action=action,
        answer=answer,
        rater=person,
        condition=person % 2,
        conditions=["pr-told", "regret-told"],
    )
    arguments = ["delivery", str(tmp_path), "--out", str(tmp_path / "out"), *SHORT]
    assert run_study.main([*arguments, "people.least=6"]) == 0
    rows = pd.read_csv(tmp_path / "out" / "results.csv")
    assert list(rows) == COLUMNS
    assert set(rows["group"]) == {"all", "pr-told", "regret-told", "pr", "regret"}
    acting = pd.read_csv(tmp_path / "out" / "acting.csv")
    assert set(acting["method"]) == {"popl", "pooled_cpl"}
    assert acting["planned"].le(1 + 1e-6).all()
    fits = pd.read_csv(tmp_path / "out" / "response.csv").set_index(["group", "label"])
    fitted = fits["log_likelihood"]
    assert fitted["pr-told", "return"] > fitted["pr-told", "regret"]
    persons = pd.read_csv(tmp_path / "out" / "response_people.csv").set_index("group")
    told = persons.loc["pr-told"]  # the others look at what is near to regret
    assert (told["label"] == "return").all()
    assert told[["mistake", "tie", "tie_error"]].max().max() == 0
    assert (tmp_path / "out" / "walks.png").is_file()
    assert "How many further answers" in capsys.readouterr().out


@pytest.mark.slow
def test_a_study_of_arguments(tmp_path):
    rng = np.random.default_rng(1)
    words = ["tea", "milk", "sun", "rain", "fish", "tree"]
    texts = [" ".join(rng.choice(words, size)) for size in rng.integers(2, 30, 20)]
    items = [f"arg{number}" for number in range(20)]
    pd.DataFrame({"item": items, "topic": "all", "text": texts}).to_csv(
        tmp_path / "arguments.csv.gz", index=False
    )
    rows = []
    for person in range(12):
        for _ in range(20):
            one, two = rng.choice(20, 2, replace=False)
            longer = len(texts[two]) > len(texts[one])
            rows.append((person, items[one], items[two], int(longer == (person % 2 == 0))))
    columns = ["rater", "first", "second", "answer"]
    pd.DataFrame(rows, columns=columns).to_csv(
        tmp_path / "arguments_comparisons.csv.gz", index=False
    )
    out = tmp_path / "out"
    assert run_study.main(["arguments", str(tmp_path), "--out", str(out), *SHORT]) == 0
    wants = pd.read_csv(out / "wants.csv")
    assert wants["length"].max() > 0.5
    assert wants["length"].min() < -0.5
    assert "prefers:" in (out / "pairs.md").read_text()


@pytest.fixture
def dialogues(tmp_path):
    """Helpful people want long replies, harmless ones the word sorry; jailbreaks are long."""
    rng = np.random.default_rng(2)
    words = ["tea", "milk", "sun", "rain", "fish", "tree"]

    def reply(size, refuses):
        return " ".join([*(["sorry"] * refuses), *rng.choice(words, size)])

    with gzip.open(tmp_path / "dialogues.jsonl.gz", "wt") as file:
        for number in range(400):
            sizes = rng.choice(np.arange(2, 30), 2, replace=False)
            refuses = int(rng.integers(2))
            one, two = (reply(size, refuses != side) for side, size in enumerate(sizes))
            harmless = number % 2 == 0
            first = refuses == 1 if harmless else sizes[0] > sizes[1]
            chosen, rejected = (one, two) if first else (two, one)
            row = {"prompt": "Human: so?", "objective": "harmless" if harmless else "helpful"}
            row |= {"chosen": f"Human: so? {chosen}", "rejected": f"Human: so? {rejected}"}
            file.write(json.dumps(row) + "\n")
    with gzip.open(tmp_path / "jailbreaks.jsonl.gz", "wt") as file:
        for _ in range(20):
            replies = [reply(4, True), reply(40, False)]
            file.write(json.dumps({"prompt": "Human: do!", "responses": replies}) + "\n")
    return tmp_path


@pytest.mark.slow
def test_a_study_of_jailbreaks(dialogues, tmp_path, capsys):
    more = ["method.members=8", "method.generations=5", "method.training.steps=150"]
    more += ["method.popl.warm_up=20", "people.folds=3", "people.methods=[popl]"]
    arguments = ["jailbreaks", str(dialogues), "--out", str(tmp_path / "out"), *more]
    assert run_study.main(arguments) == 0
    rows = pd.read_csv(tmp_path / "out" / "results.csv", keep_default_na=False)
    assert list(rows) == COLUMNS
    value = rows.set_index(["method", "choice", "group", "measure"])["value"]
    for objective in ("helpful", "harmless"):
        assert value["oracle", objective, objective, "accuracy"] > 0.9
        assert value["popl", objective, objective, "gain_over_bradley_terry_low"] > 0
    assert value["oracle", "helpful", "all", "jailbreaks"] == 1
    assert value["oracle", "harmless", "all", "jailbreaks"] == 0
    assert value["popl", "harmless", "all", "jailbreaks_ratio"] < 0.7
    # A study that was killed goes on: what is there is kept, and the rest comes out the same.
    cells = tmp_path / "out" / "comparison" / "cells"
    times = {path.name: path.stat().st_mtime_ns for path in cells.glob("*.csv")}
    assert len(times) == 3 * 4
    (cells / "popl-1.csv").unlink()
    (tmp_path / "out" / "results.csv").unlink()
    assert run_study.main(arguments) == 0
    again = pd.read_csv(tmp_path / "out" / "results.csv", keep_default_na=False)
    pd.testing.assert_frame_equal(again, rows)
    written = {
        path.name for path in cells.glob("*.csv") if path.stat().st_mtime_ns != times[path.name]
    }
    assert written == {"popl-1.csv"}
    choices = set(rows[rows["method"] == "dpl_categorical"]["choice"])
    assert choices == {"expectation", "risk_averse"}
    assert "jailbreaks" in capsys.readouterr().out


def test_dialogues_that_make_no_sense_are_refused(dialogues, tmp_path, capsys):
    path = dialogues / "dialogues.jsonl.gz"
    lines = gzip.decompress(path.read_bytes()).replace(b'"harmless"', b'"dull"')
    path.write_bytes(gzip.compress(lines))
    arguments = ["jailbreaks", str(dialogues), "--out", str(tmp_path / "out")]
    assert run_study.main(arguments) == 2
    assert "objective must be one of helpful, harmless, got {'dull'}" in capsys.readouterr().err
    with gzip.open(path, "wt") as file:
        file.write('{"prompt": ""}\n')
    assert run_study.main(arguments) == 2
    assert "line 1: chosen, rejected missing" in capsys.readouterr().err


def test_returns_of_the_optimum_and_of_random_steps():
    table = DeliveryGrid().transition_table()
    planned = exact_returns(table, table.steps["reward"])[1]
    assert planned == pytest.approx(1)


def test_conditions_say_what_people_were_led_to():
    names = ["pr-trained", "regret-question", "trained-control", ""]
    assert [led_to(name) for name in names] == ["pr", "regret", "", ""]


def test_missing_data_are_refused(tmp_path, capsys):
    assert run_study.main(["delivery", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "data.load must be" in capsys.readouterr().err
