"""Real people's answers in, and judged by people who were held out: the commands, end to end."""

import csv
import math
from contextlib import nullcontext

import numpy as np
import pandas as pd
import pytest

from popl_rl.models.sets import load_set
from popl_rl.storage import load_tensordict
from popl_rl.trainers import evaluate_policies, export_data, import_data, judge_people
from popl_rl.trainers.train_popl import Result, run, show

SHORT = [
    "raters=people",
    "method.hidden=[]",
    "method.members=4",
    "method.generations=3",
    "method.training.steps=90",
    "method.training.batch_size=64",
    "method.training.learning_rate=0.05",
    "method.training.alpha=1",
    "method.refinement.steps=60",
    "people.folds=3",
    "people.curve=[0,5]",
    "people.most_groups=2",
    "evaluation.figures=false",
    "logger=csv",
]


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """24 people, of whom half want large items and half want small ones; condition says who."""
    folder = tmp_path_factory.mktemp("table")
    rng = np.random.default_rng(0)
    size = rng.normal(size=(30, 2))
    with (folder / "items.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["item", "size", "colour"])
        writer.writerows([f"i{number}", *values] for number, values in enumerate(size))
    with (folder / "said.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["rater", "first", "second", "answer", "condition"])
        for person in range(24):
            for _ in range(14):
                one, two = rng.choice(30, 2, replace=False)
                large = size[two, 0] > size[one, 0]
                answer = int(large) if person % 2 else int(not large)
                writer.writerow(
                    [f"p{person}", f"i{one}", f"i{two}", answer, "large" if person % 2 else "small"]
                )
    return folder


@pytest.fixture(scope="module")
def imported(table):
    target = table / "folder"
    options = [f"items={table}/items.csv"]
    assert import_data.main([str(table / "said.csv"), str(target), *options]) == 0
    return target


def test_processes_that_encode_share_the_threads_of_this_one(tmp_path, monkeypatch):
    pairs = tmp_path / "pairs.jsonl"
    pairs.write_text(
        '{"chosen": "short words", "rejected": "a longer text of words"}\n'
        '{"chosen": "short words", "rejected": "no words at all"}\n'
    )
    asked = []

    def workers(count, *, threads):
        asked.append((count, threads))
        return nullcontext(None)

    monkeypatch.setattr(import_data, "workers_for", workers)
    monkeypatch.setattr("torch.get_num_threads", lambda: 5)
    for count in ("2", "8"):
        assert import_data.main([str(pairs), "-", "encode=tfidf", f"workers={count}"]) == 0
    assert asked == [(2, 2), (8, 1)]


def test_import_tells_what_it_found(table, capsys):
    arguments = [str(table / "said.csv"), "-", f"items={table}/items.csv"]
    assert import_data.main(arguments) == 0
    said = capsys.readouterr().out
    assert "30 items, 2 features" in said
    assert "24 raters, 14.0 answers each" in said
    assert "condition small: 168 answers" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}/nothing.csv", "x"], "there is no file or folder"),
        (["{}/said.csv", "{}"], "exists; remove it"),
        (["{}/said.csv", "x", "items"], "options must be name=value, got 'items'"),
        (["{}/said.csv", "x", "items={}/items.csv", "encode=tfidf"], "needs texts"),
        (["{}/said.csv", "x", "colour=1"], "does not take colour; it takes items"),
    ],
)
def test_import_refuses_with_exit_code_2(table, capsys, arguments, message):
    assert import_data.main([each.format(table) for each in arguments]) == 2
    assert message in capsys.readouterr().err


def test_export_keeps_who_answered(imported, tmp_path, capsys):
    assert export_data.main([str(imported), str(tmp_path / "out")]) == 0
    assert set(pd.read_csv(tmp_path / "out" / "comparisons.csv")["rater"]) == {
        f"p{person}" for person in range(24)
    }
    assert export_data.main([str(imported), str(tmp_path / "out.npz")]) == 0
    assert export_data.main([str(imported), str(tmp_path / "out.npz")]) == 2
    assert "336 comparisons written" in capsys.readouterr().out


@pytest.fixture(scope="module")
def finished(config_of, imported, tmp_path_factory):
    """A run that has learnt from the people."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    drawn = "evaluation.figures=true"
    return run(config_of(*SHORT, drawn, f"data.load={imported}", f"run_dir={run_dir}"))


def test_a_run_learns_from_people_and_tells_them_apart(finished, capsys):
    result, board = finished, finished.board
    catered = board.value("popl", "all", "accuracy@5", "posterior")
    assert catered > board.value("pooled_cpl", "all", "accuracy@5") + 0.2
    # Groups are told by a column, and have rows of their own.
    assert board.value("popl", "large", "people@5") + board.value("popl", "small", "people@5") == 8
    for name in ("people.csv", "results.csv", "report.md", "figures/people.png", "metrics.csv"):
        assert (result.run_dir / name).is_file()
    assert len(load_set(result.run_dir / "rewards")) == len(result.policies)
    show(result)
    assert "How many further answers of new people" in capsys.readouterr().out
    people = pd.read_csv(result.run_dir / "people.csv")
    assert people.groupby("method")["person"].nunique().eq(8).all()


def test_a_finished_run_is_judged_again_by_the_people_it_held_out(config_of, finished, capsys):
    run_dir = finished.run_dir
    own = evaluate_policies.run(config_of(f"run_dir={run_dir}", "seed=0", name="evaluate"))[1]
    pd.testing.assert_frame_equal(own.results, finished.board.results)
    asked = [f"run_dir={run_dir}", "people.curve=[0,3]", "people.repeats=2"]
    folder, board = evaluate_policies.run(config_of(*asked, name="evaluate"))
    assert folder == run_dir / "evaluations" / "002"
    assert board.value("popl", "all", "people@3", "posterior") == 8
    assert board.value("popl", "all", "accuracy@3", "posterior") > 0.8
    assert math.isfinite(board.value("individual", "all", "accuracy@3"))
    people = [pd.read_csv(path / "people.csv") for path in (run_dir, folder)]
    assert set(people[0]["person"]) == set(people[1]["person"])
    for name in ("config.yaml", "results.csv", "report.md", "figures/people.png"):
        assert (folder / name).is_file()
    show(Result(folder, finished.policies, board))
    assert "after 3" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["evaluation.answers=5"], "real people judge this one; .* such as people.curve="),
        (["people.folds=2"], "people.folds says from whom a run learns .* only people.curve"),
        (["people.curve=[-1]"], "people.curve"),
    ],
)
def test_what_a_finished_run_cannot_be_asked_is_refused(config_of, finished, settings, message):
    with pytest.raises(ValueError, match=message):
        evaluate_policies.run(config_of(f"run_dir={finished.run_dir}", *settings, name="evaluate"))


def test_what_predicts_by_more_than_its_set_is_not_judged_again(config_of, imported, tmp_path):
    more = [f"data.load={imported}", f"run_dir={tmp_path / 'run'}"]
    run(config_of("method=lore", *SHORT, "method.generations=1", *more))
    with pytest.raises(ValueError, match=r"runs of method lore .* by popl-people"):
        evaluate_policies.run(config_of(f"run_dir={tmp_path / 'run'}", name="evaluate"))


def test_conditions_are_never_read_by_a_learner(config_of, table, tmp_path):
    said = pd.read_csv(table / "said.csv")
    said["condition"] = "the same"
    said.to_csv(tmp_path / "other.csv", index=False)
    results = []
    for name, path in (("one", table / "said.csv"), ("two", tmp_path / "other.csv")):
        more = [f"data.load={path}", f"+data.reader_options.items={table}/items.csv"]
        results.append(run(config_of(*SHORT, *more, f"run_dir={tmp_path / name}")))
    one, two = (result.board.results.query("group == 'all'") for result in results)
    pd.testing.assert_frame_equal(one, two.reset_index(drop=True).set_index(one.index))


def test_methods_are_compared_and_a_killed_comparison_goes_on(config_of, imported, tmp_path):
    more = [
        f"data.load={imported}",
        f"run_dir={tmp_path / 'run'}",
        "people.methods=[popl,em,vpl,lore]",
        "people.folds=2",
    ]
    config = config_of(*SHORT[1:], *more, name="people")
    result = judge_people.run(config)
    kept = result.results.set_index(["method", "choice", "group", "measure"])["value"]
    assert kept["em", "posterior", "all", "accuracy@5"] > 0.8
    assert kept["popl", "posterior", "all", "gain_over_pooled_cpl_low@5"] > 0
    assert math.isfinite(kept["vpl", "encoder", "all", "log_likelihood@5"])
    assert kept["lore", "fitted", "all", "accuracy@5"] > 0.8
    assert math.isfinite(kept["individual", "", "all", "accuracy@5"])
    assert kept["popl", "posterior", "all", "people@0"] == 24
    (tmp_path / "run" / "cells" / "em-1.csv").unlink()
    (tmp_path / "run" / "results.csv").unlink()
    damaged = tmp_path / "run" / "cells" / "popl-0.csv"
    damaged.write_text("".join(damaged.read_text().splitlines(keepends=True)[:-3]))
    with pytest.warns(UserWarning, match=r"popl-0\.csv was changed .* it is made again"):
        again = judge_people.run(config_of(f"resume={tmp_path / 'run'}", name="people"))
    pd.testing.assert_frame_equal(again.results, result.results)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["people.least=15"], "needs as many people with 15 strict answers .* got 0"),
        (["people.methods=[nonsense]"], "people.methods must be of cpl, em"),
        (["people.folds=1"], "people.folds must be at least 2, got 1"),
    ],
)
def test_what_cannot_be_judged_is_refused(config_of, imported, tmp_path, settings, message):
    config = config_of(
        *SHORT[1:], f"data.load={imported}", f"run_dir={tmp_path / 'run'}", *settings, name="people"
    )
    with pytest.raises(ValueError, match=message):
        judge_people.run(config)


def test_without_raters_to_simulate_there_must_be_data(config_of):
    with pytest.raises(ValueError, match=r"raters\.groups must be one or more rater references"):
        run(config_of("raters=people"))


def test_answers_without_ids_cannot_be_held_out(config_of, table, tmp_path):
    pd.read_csv(table / "said.csv").drop(columns="rater").to_csv(tmp_path / "no.csv", index=False)
    more = [f"data.load={tmp_path}/no.csv", f"+data.reader_options.items={table}/items.csv"]
    with pytest.raises(ValueError, match="the answers carry no rater ids"):
        run(config_of(*SHORT, *more, f"run_dir={tmp_path / 'run'}"))


def test_ties_and_soft_labels_count_in_training(config_of, table, tmp_path):
    said = pd.read_csv(table / "said.csv")
    said["answer"] = said["answer"].astype(float).replace({0.0: 0.1, 1.0: 0.9})
    said.loc[::7, "answer"] = 0.5
    said.loc[::9, "rater"] = np.nan
    said.to_csv(tmp_path / "soft.csv", index=False)
    more = [
        f"data.load={tmp_path}/soft.csv",
        f"+data.reader_options.items={table}/items.csv",
        "method.ties=count",
        "people.least=8",
    ]
    result = run(config_of(*SHORT, *more, f"run_dir={tmp_path / 'run'}"))
    assert result.board.value("popl", "all", "accuracy@5", "posterior") > 0.7


@pytest.fixture
def alike(tmp_path):
    """``alike(say)``: items, and 20 rows of what each of 12 people who agree says, by ``say``."""
    rng = np.random.default_rng(0)
    size = rng.normal(size=(30, 2))
    frame = pd.DataFrame(size, columns=["size", "colour"])
    frame.insert(0, "item", [f"i{number}" for number in range(30)])
    frame.to_csv(tmp_path / "items.csv", index=False)

    def make(say):
        rows = [
            {"rater": f"p{n}", **say(2 * size[:, 0], rng)} for n in range(12) for _ in range(20)
        ]
        pd.DataFrame(rows).to_csv(tmp_path / "said.csv", index=False)
        return [
            f"data.load={tmp_path}/said.csv",
            f"+data.reader_options.items={tmp_path}/items.csv",
            f"run_dir={tmp_path / 'run'}",
        ]

    return make


def test_the_threshold_of_ties_is_found_and_told(config_of, alike, tmp_path):
    def say(value, rng):  # Rao and Kupper (1967)
        one, two = rng.choice(30, 2, replace=False)
        difference = value[two] - value[one] + np.array([-0.7, 0.7])
        second, not_first = 1 / (1 + np.exp(-difference))
        answer = rng.choice(3, p=[1 - not_first, second, not_first - second])
        return {"first": f"i{one}", "second": f"i{two}", "answer": answer}

    config = config_of(*SHORT, *alike(say), "method.ties=rao_kupper", "people.least=8")
    board = run(config).board
    report = (tmp_path / "run" / "report.md").read_text()
    found = float(report.partition("tie threshold | ")[2].partition(" ")[0])
    assert found == pytest.approx(0.7, abs=0.2)
    assert board.value("popl", "all", "accuracy@5", "posterior") > 0.75


def test_rankings_are_read_learnt_from_and_the_best_item_wins(config_of, alike):
    def say(value, rng):  # the largest of value and Gumbel noise first, and so on
        some = rng.choice(30, 4, replace=False)
        order = some[np.argsort(-value[some] - rng.gumbel(size=4))]
        return {"ranking": " > ".join(f"i{number}" for number in order)}

    config = config_of(*SHORT, *alike(say))
    result = run(config)
    features = load_tensordict(result.run_dir / "data" / "segments")["observation"][:, 0]
    utility = result.policies.population(features)[result.policies.fair_member, :, 0]
    assert int(utility.argmax()) == int(features[:, 0].argmax())
    assert result.board.value("popl", "all", "accuracy@5", "posterior") > 0.75
