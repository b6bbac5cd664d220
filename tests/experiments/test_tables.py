import math

import pandas as pd
import pytest

from popl_rl.evaluation.statistics import differs_from_zero
from popl_rl.experiments.tables import (
    COLUMNS,
    ResultTable,
    fill_tables,
    make_tables,
    read_tables,
    rows_for,
)


def test_a_cell_is_the_worst_group_over_seeds():
    """Worst groups 0.4, 0.6 and 0.8: mean 0.6, standard error 0.2 / √3, t(0.975, 2) = 4.303."""
    rows = [
        ("s", "two", seed, "popl", "", group, "recovery", value)
        for seed, *worths in [(0, 0.4, 0.9), (1, 0.8, 0.6), (2, 0.8, 0.8)]
        for group, value in zip("ab", worths, strict=True)
    ]
    table = ResultTable("s", "recovery", {("popl", ""): "`popl`"}, {"two": "two", "three": "three"})
    lines = table.markdown(pd.DataFrame(rows, columns=COLUMNS)).splitlines()
    assert lines[-1] == "| `popl` | 0.60 ± 0.50 [0.40] | – |"
    lines = table.markdown(pd.DataFrame(rows[:-2], columns=COLUMNS)).splitlines()
    assert lines[-1] == "| `popl` | 0.50 [0.40] | – |", "two seeds tell no interval"


def test_scenarios_may_be_rows():
    rows = [("s", "two", 0, m, "", "a", "success", v) for m, v in (("popl", 1.0), ("cpl", 0.5))]
    methods = {("popl", ""): "`popl`", ("cpl", ""): "pooled CPL"}
    scenarios = {"two": "two groups", "three": "three groups"}
    table = ResultTable("s", "success", methods, scenarios, transposed=True)
    assert table.markdown(pd.DataFrame(rows, columns=COLUMNS)).splitlines() == [
        "| scenario | `popl` | pooled CPL |",
        "| --- | ---: | ---: |",
        "| two groups | 1.00 | 0.50 |",
        "| three groups | – | – |",
    ]


def test_a_group_whose_value_is_unknown_is_not_hidden_by_the_others():
    rows = [
        ("s", "two", seed, "popl", "", group, "recovery", value)
        for seed, *each in [(0, 0.4, 0.9), (1, 0.8, math.nan)]
        for group, value in zip("ab", each, strict=True)
    ]
    for over, shown in (("worst", "0.40"), ("mean", "0.65")):
        table = ResultTable("s", "recovery", {("popl", ""): "`popl`"}, {"two": "two"}, over)
        for kept, cell in ((rows, shown), (rows[2:], "–")):
            assert table.markdown(pd.DataFrame(kept, columns=COLUMNS)).endswith(f"| {cell} |")


@pytest.mark.parametrize(("value", "shown"), [(-0.004, "0.00"), (-0.5, "−0.50"), (1.0, "1.00")])
def test_numbers_have_two_decimals_and_a_minus_sign(value, shown):
    rows = pd.DataFrame([("s", "two", 0, "cpl", "", "a", "return", value)], columns=COLUMNS)
    table = ResultTable("s", "return", {("cpl", ""): "pooled CPL"}, {"two": "two"})
    assert table.markdown(rows).endswith(f"| {shown} |")


def test_marked_tables_are_replaced_and_nothing_else():
    text = "before\n<!-- table: t -->\nold\n<!-- end -->\nafter\n"
    filled = fill_tables(text, {"t": "| new |"})
    assert filled == "before\n<!-- table: t -->\n| new |\n<!-- end -->\nafter\n"
    assert fill_tables(filled, {"t": "| new |"}) == filled


def test_an_unknown_table_is_named():
    with pytest.raises(ValueError, match="'u'"):
        fill_tables("<!-- table: u -->\n<!-- end -->", {"t": ""})


@pytest.fixture
def described(tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(
        '[t]\nsuite = "s"\nmeasure = "recovery"\nmethods = [["cpl", "", "pooled CPL"]]\n'
        'scenarios = {two = "two groups"}\n'
    )
    return path


def test_tables_are_described_in_a_file(described):
    [table] = read_tables(described).values()
    assert table == ResultTable("s", "recovery", {("cpl", ""): "pooled CPL"}, {"two": "two groups"})


def test_a_table_without_a_measure_is_named(tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text('[broken]\nsuite = "s"\nmethods = []\nscenarios = {}\n')
    with pytest.raises(ValueError, match="'broken'"):
        read_tables(path)


def test_only_rows_that_a_table_shows_are_kept(described):
    rows = pd.DataFrame(
        [
            ("s", "two", 0, "cpl", "", "a", "recovery", 0.5),
            ("s", "two", 0, "cpl", "", "all", "recovery", 0.5),
            ("s", "two", 0, "cpl", "", "a", "accuracy", 0.6),
            ("s", "three", 0, "cpl", "", "a", "recovery", 0.7),
            ("s", "two", 0, "cpl", "lexicase", "a", "recovery", 0.8),
            ("other", "two", 0, "cpl", "", "a", "recovery", 0.9),
        ],
        columns=COLUMNS,
    )
    tables = read_tables(described)
    assert rows_for(tables, rows).values.tolist() == rows.head(1).values.tolist()
    rows.to_csv(described.parent / "s.csv", index=False)
    assert make_tables(tables, described.parent)["t"].endswith("| pooled CPL | 0.50 |")


def test_a_suite_that_was_not_run_has_empty_cells(described):
    made = make_tables(read_tables(described), described.parent)
    assert made["t"].endswith("| pooled CPL | – |")


def test_differences_are_paired_over_seeds():
    """Means over groups 0.5, 0.7 and 0.9 against 0.4, 0.5 and 0.6: differences 0.1, 0.2, 0.3."""
    rows = [
        ("s", "two", seed, method, "", group, "recovery", value + shift)
        for method, values in [("popl", [0.5, 0.7, 0.9]), ("em", [0.6, 0.5, 0.4])]
        for seed, value in zip((0, 1, 2) if method == "popl" else (2, 1, 0), values, strict=True)
        for group, shift in [("a", 0.1), ("b", -0.1)]
    ]
    table = ResultTable(
        "s", "recovery", {("popl", ""): "`popl`"}, {"two": "two"}, over="mean", against=("em", "")
    )
    text = table.markdown(pd.DataFrame(rows, columns=COLUMNS))
    assert text.endswith("| `popl` | 0.20 ± 0.25 |")  # t(0.975, 2) = 4.303 times 0.1 / sqrt(3)


def test_measures_of_all_groups_together():
    rows = [
        ("s", "two", seed, "popl", "", group, "distinct", value)
        for seed, group, value in [(0, "all", 4), (0, "a", 9), (1, "all", 6), (2, "all", 8)]
    ]
    table = ResultTable("s", "distinct", {("popl", ""): "`popl`"}, {"two": "two"}, over="all")
    assert "6.00 ± 4.97 [4.00]" in table.markdown(pd.DataFrame(rows, columns=COLUMNS))


def test_what_differs_is_judged_together():
    """P-values of 0.003 and 0.026: at 2 % for both, the lower must be below 1 %, the other 2 %."""
    clear, weak = [1.0, 1.1, 0.9], [0.5, 0.9, 0.7]
    assert differs_from_zero([clear, weak, [0.1], []]) == [True, True, False, False]
    assert differs_from_zero([clear, weak], level=0.02) == [True, False]
    assert differs_from_zero([[0.2, 0.2]]) == [False]  # no spread, no test
