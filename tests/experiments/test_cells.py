import json

import pandas as pd
import pytest

from popl_rl.evaluation.statistics import RESULT_COLUMNS, worst
from popl_rl.experiments.cells import COLUMNS, claim, collect, is_finished, plan, results_digest
from popl_rl.experiments.suites import parse_suite
from popl_rl.manifest import sealed
from popl_rl.storage import write_json

SUITE = parse_suite(
    "sweep",
    {
        "overrides": ["env=gym"],
        "methods": {"popl": [], "mine": ["method=popl_published"]},
        "scenarios": {
            "few": {
                "overrides": ["method.members=2"],
                "at": {"members": 2},
                "methods": ["mine"],
                "data_of": "base",
            },
            "base": {"overrides": [], "at": {"members": 9, "noise": 0}},
            "noisy": {"overrides": ["raters.response.mistake=0.1"], "at": {"noise": 0.1}},
        },
    },
)


def test_cells_are_planned_seed_by_seed_and_makers_of_data_first():
    cells = plan(SUITE, seeds=2)
    assert [cell.name for cell in cells[:5]] == [
        "base/popl/seed0",
        "noisy/popl/seed0",
        "base/mine/seed0",
        "noisy/mine/seed0",
        "few/mine/seed0",
    ]
    assert [cell.name for cell in cells[5:]] == [
        cell.name.replace("seed0", "seed1") for cell in cells[:5]
    ]
    assert plan(SUITE, seeds=3)[:10] == cells, "more seeds leave the numbers of cells as they are"


def test_cells_use_the_data_of_the_first_method_in_their_scenario_or_in_another():
    sources = {cell.name: cell.source and cell.source.name for cell in plan(SUITE, seeds=2)}
    assert sources["base/popl/seed1"] is None
    assert sources["base/mine/seed1"] == "base/popl/seed1"
    assert sources["noisy/mine/seed0"] == "noisy/popl/seed0"
    assert sources["few/mine/seed1"] == "base/popl/seed1"
    leading = {cell.name for cell in plan(SUITE, seeds=1) if cell.leads}
    assert leading == {"base/popl/seed0", "noisy/popl/seed0", "few/mine/seed0"}


def test_overrides_go_from_the_suite_over_the_scenario_to_the_method():
    cells = {cell.name: cell for cell in plan(SUITE, seeds=1)}
    expected = ("env=gym", "method.members=2", "method=popl_published")
    assert cells["few/mine/seed0"].overrides == expected


def test_a_scenario_on_two_axes_is_run_once():
    names = [cell.name for cell in plan(SUITE, seeds=3)]
    assert len(names) == len(set(names)) == 15


def test_seeds_are_counted():
    with pytest.raises(ValueError, match="seeds must be at least 1, got 0"):
        plan(SUITE, seeds=0)


# Folders


def finish(cell, run_dir, rows=(), seconds=1.5, name="popl"):
    """What a cell leaves whose configuration calls its method ``name``."""
    folder = cell.folder(run_dir)
    folder.mkdir(parents=True)
    table = pd.DataFrame(rows, columns=RESULT_COLUMNS)
    (folder / "config.yaml").write_text(f"method: {{name: {name}}}")
    table.to_csv(folder / "results.csv", index=False)
    (folder / "cell.json").write_text(json.dumps({**cell.record(), "seconds": seconds}))


def test_a_cell_is_finished_when_both_its_files_are_there(tmp_path):
    cell = plan(SUITE, seeds=1)[0]
    assert not is_finished(cell, tmp_path)
    finish(cell, tmp_path)
    assert is_finished(cell, tmp_path)
    for name in ("results.csv", "cell.json"):
        path = cell.folder(tmp_path) / name
        content = path.read_text()
        path.unlink()
        assert not is_finished(cell, tmp_path)
        path.write_text(content)


def cut(text):
    return text[:-9]


def without_a_row(text):
    return "".join(text.splitlines(keepends=True)[:-1])


def another_number(text):
    return text.replace("1.5", "1.6").replace("0.8", "0.9")


@pytest.mark.parametrize("file", ["cell.json", "results.csv"])
@pytest.mark.parametrize("damage", [cut, without_a_row, another_number, lambda _: ""])
def test_a_cell_whose_record_or_results_are_damaged_is_not_finished(tmp_path, file, damage):
    cell = plan(SUITE, seeds=1)[0]
    finish(cell, tmp_path, found(0.9))
    folder = cell.folder(tmp_path)
    record = {**cell.record(), "seconds": 1.5, "results": results_digest(folder)}
    write_json(folder / "cell.json", sealed(record))
    assert is_finished(cell, tmp_path)
    (folder / file).write_text(damage((folder / file).read_text()))
    with pytest.warns(UserWarning, match="the cell is run again"):
        assert collect(SUITE, [cell], tmp_path).empty


def test_a_damaged_benchmark_json_is_named_with_a_cure(tmp_path):
    cells = plan(SUITE, seeds=1)
    claim(tmp_path, SUITE, cells)
    (tmp_path / "benchmark.json").write_text("{")
    with pytest.raises(ValueError, match=r"benchmark\.json is damaged.*remove it if .* of suite"):
        claim(tmp_path, SUITE, cells)


def test_a_cell_that_was_run_as_something_else_is_an_error(tmp_path):
    definition = {"methods": {"popl": [], "mine": []}, "scenarios": {"a": ["x=1", "y=1"]}}
    before = plan(parse_suite("s", definition), seeds=1)
    for cell in before:
        finish(cell, tmp_path)
    definition["scenarios"]["a"] = ["x=1", "y=2"]
    now = plan(parse_suite("s", definition), seeds=1)
    message = (
        r"cell a/popl/seed0 was run with other settings \(overrides was \['y=1'\] and is "
        r"\['y=2'\]\): delete .*seed0 to run it again, or choose another run_dir"
    )
    with pytest.raises(ValueError, match=message):
        is_finished(now[0], tmp_path)
    with pytest.raises(ValueError, match="cell a/popl/seed0 was run with other settings"):
        collect(SUITE, now, tmp_path)


def test_a_cell_on_other_data_is_something_else(tmp_path):
    """Another first method makes the baselines anew, so the old recoveries are of another run."""
    scenarios = {"a": []}
    old = parse_suite("s", {"methods": {"popl": [], "mine": ["m=1"]}, "scenarios": scenarios})
    new = parse_suite("s", {"methods": {"popl": ["m=2"], "mine": ["m=1"]}, "scenarios": scenarios})
    finish(plan(old, seeds=1)[1], tmp_path)
    with pytest.raises(ValueError, match=r"a/mine/seed0 .*\(data_of was .* and is \['m=2'\]\)"):
        is_finished(plan(new, seeds=1)[1], tmp_path)


def test_a_folder_belongs_to_one_suite(tmp_path):
    cells = plan(SUITE, seeds=1)
    claim(tmp_path / "new", SUITE, cells)
    claim(tmp_path / "new", SUITE, cells)
    table = pd.read_csv(tmp_path / "new" / "cells.csv")
    assert table.values.tolist()[4] == [4, "few", "mine", 0]
    other = parse_suite("other", {"methods": {"popl": []}, "scenarios": {"a": []}})
    with pytest.raises(ValueError, match=r"holds suite 'sweep', not 'other'; choose another run"):
        claim(tmp_path / "new", other, plan(other, seeds=1))
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ValueError, match="holds something else; choose another run_dir"):
        claim(tmp_path, SUITE, cells)


# Results


def found(recovery, *, oracle=1.0):
    """What a run writes: two groups, of which the second is served worse by 0.1."""
    rows = []
    for entry, value in {
        ("popl", "posterior"): recovery,
        ("popl", "lexicase"): recovery / 2,
        ("oracle", ""): oracle,
    }.items():
        rows.append((*entry, "upper", "recovery", value))
        rows.append((*entry, "lower", "recovery", value - 0.1))
    return [*rows, ("random", "", "upper", "return", 0.0)]


def test_results_get_the_name_of_the_method_and_others_come_from_the_first(tmp_path):
    base_popl, noisy_popl, base_mine, _, few_mine = plan(SUITE, seeds=1)
    finish(base_popl, tmp_path, found(0.9, oracle=1.0))
    finish(base_mine, tmp_path, found(0.5, oracle=7.0), seconds=None)
    finish(few_mine, tmp_path, found(0.4, oracle=0.8))
    results = collect(SUITE, plan(SUITE, seeds=1), tmp_path)
    assert list(results) == COLUMNS
    assert set(results.suite) == {"sweep"}
    assert set(results.seed) == {0}
    assert not results.duplicated(COLUMNS[:-1]).any()
    of = results.set_index(["scenario", "method", "choice", "group", "measure"]).value.to_dict()
    assert of["base", "popl", "posterior", "upper", "recovery"] == 0.9
    assert of["base", "mine", "posterior", "upper", "recovery"] == 0.5
    assert of["base", "mine", "lexicase", "upper", "recovery"] == 0.25
    assert of["base", "oracle", "", "upper", "recovery"] == 1.0, "not the 7 of the second method"
    assert of["few", "mine", "posterior", "upper", "recovery"] == 0.4
    assert of["few", "oracle", "", "upper", "recovery"] == 0.8
    assert of["base", "popl", "", "all", "seconds"] == 1.5
    assert ("base", "mine", "", "all", "seconds") not in of, "its time is unknown"
    assert len(of) == 8 + 4 + 8
    assert results.scenario.unique().tolist() == ["few", "base"], "in the suite's order"
    assert noisy_popl.scenario not in set(results.scenario), "it is not finished"


@pytest.mark.parametrize("label", ["cpl", "em", "mine_too"])
def test_what_a_cell_trained_gets_the_methods_name_whatever_it_is(tmp_path, label):
    """Its rows are not those of the first cell, and those of baselines stay the baselines'."""
    suite = parse_suite("s", {"methods": {"popl": [], "mine": []}, "scenarios": {"a": []}})
    first, second = plan(suite, seeds=1)
    finish(
        first,
        tmp_path,
        [("popl", "posterior", "g", "accuracy", 0.9), ("pooled_cpl", "", "g", "accuracy", 0.6)],
    )
    own = [(label, "posterior", "g", "accuracy", 0.7), (label, "lexicase", "g", "accuracy", 0.5)]
    finish(second, tmp_path, [*own, ("pooled_cpl", "", "g", "accuracy", 0.1)], name=label)
    results = collect(suite, [first, second], tmp_path)
    of = results[results.measure == "accuracy"].set_index(["method", "choice"])
    assert of.value.to_dict() == {
        ("popl", "posterior"): 0.9,
        ("pooled_cpl", ""): 0.6,
        ("mine", "posterior"): 0.7,
        ("mine", "lexicase"): 0.5,
    }


def test_nothing_is_finished(tmp_path):
    results = collect(SUITE, plan(SUITE, seeds=1), tmp_path)
    assert list(results) == COLUMNS
    assert results.empty
    assert worst(results).empty


def test_a_method_may_not_have_the_name_of_a_row_of_another(tmp_path):
    suite = parse_suite("s", {"methods": {"popl": [], "dpl": []}, "scenarios": {"a": []}})
    first, second = plan(suite, seeds=1)
    finish(first, tmp_path, [("popl", "", "g", "accuracy", 1.0), ("dpl", "", "g", "accuracy", 0.5)])
    finish(second, tmp_path, [("popl", "", "g", "accuracy", 1.0)])
    with pytest.raises(ValueError, match="rows of method 'dpl' in scenario 'a'; give the suite's"):
        collect(suite, [first, second], tmp_path)


def test_the_worst_group_of_each_run_counts(tmp_path):
    cells = plan(SUITE, seeds=2)
    for cell, recovery in zip((cells[0], cells[5]), (0.9, 0.7), strict=True):
        finish(cell, tmp_path, found(recovery))
    table = worst(collect(SUITE, cells, tmp_path))
    assert table.method.unique().tolist() == ["popl"]
    assert set(table.choice) == {"posterior", "lexicase"}
    given = table[table.choice == "posterior"]
    assert given.value.tolist() == pytest.approx([0.8, 0.6])
    assert given.seed.tolist() == [0, 1]
