import json
import math

import pandas as pd
import pytest

from popl_rl.experiments.benchmark_report import benchmark_markdown, write_report
from popl_rl.experiments.benchmark_tables import catering_table, recovery_table, stands_out
from popl_rl.experiments.cells import COLUMNS, plan
from popl_rl.experiments.suites import parse_suite

SUITE = parse_suite(
    "mine",
    {
        "overrides": ["env.max_steps=9"],
        "methods": {"popl": [], "other": ["method=popl_published"]},
        "scenarios": {
            "plain": [],
            "base": {"overrides": ["data.length=5"], "at": {"noise": 0}},
            "noisy": {"overrides": ["raters.response.mistake=0.1"], "at": {"noise": 0.1}},
        },
    },
)


def table(*rows):
    """Rows of scenario, method (and choice), group, measure, and a value for each seed."""
    return pd.DataFrame(
        [
            ("mine", scenario, seed, *entry(method), group, measure, value)
            for scenario, method, group, measure, values in rows
            for seed, value in enumerate(values)
        ],
        columns=COLUMNS,
    )


def entry(method):
    """Method and choice; catered by the posterior if it is the suite's and nothing is said."""
    if isinstance(method, tuple):
        return method
    return method, "posterior" if method in SUITE.methods else ""


def recoveries(scenario, method, values):
    return (scenario, method, "upper", "recovery", values)


def lines(text):
    return [line for line in text.splitlines() if line.startswith("|") and "---" not in line]


def test_the_recovery_of_the_worst_group_by_scenario_and_method():
    """Standard error of 0.8, 0.9, 1.0 is 0.1 / sqrt(3); times 4.303 (t, two degrees): 0.25."""
    results = table(
        recoveries("plain", "pooled_cpl", [0.1, 0.2, 0.3]),
        recoveries("plain", "popl", [0.8, 0.9, 1.0]),
        ("plain", "popl", "lower", "recovery", [1.1, 1.1, 1.1]),
        recoveries("plain", "oracle", [1, 1, 1]),
        recoveries("base", "popl", [-0.5]),
        ("base", "popl", "all", "seconds", [7.0]),
    )
    head, rows = recovery_table(SUITE, results)
    assert head == ["scenario", "popl", "CPL on everybody's answers"]
    assert rows == [
        ["plain", "**0.90 ± 0.25 [0.80]**", "0.20 ± 0.25 [0.10]"],
        ["base", "−0.50", "–"],
    ]


def test_seeds_without_a_recovery_are_counted():
    results = table(
        recoveries("plain", "popl", [0.8, 0.8]), recoveries("plain", "pooled_cpl", [0.5, math.nan])
    )
    assert recovery_table(SUITE, results)[1] == [
        ["plain", "0.80 ± 0.00 [0.80]", "0.50 (1 of 2 seeds)"]
    ]


@pytest.mark.parametrize(
    ("intervals", "best"),
    [
        ({"a": (0.9, 0.1), "b": (0.5, 0.2)}, "a"),
        ({"a": (0.5, 0.2), "b": (0.9, 0.1), "c": (0.1, 0.1)}, "b"),
        ({"a": (0.9, 0.3), "b": (0.5, 0.2)}, None),
        ({"a": (0.9, math.nan), "b": (0.5, 0.0)}, None),
        ({"a": (0.9, 0.0), "b": (0.5, math.nan)}, None),
        ({"a": (0.9, 0.0)}, None),
        ({}, None),
    ],
)
def test_the_best_stands_out_where_its_interval_is_apart_from_all_others(intervals, best):
    assert stands_out(intervals) == best


def test_a_method_need_not_stand_out_from_its_own_other_catering():
    results = table(
        recoveries("plain", "popl", [0.92, 0.94]),
        recoveries("plain", ("popl", "lexicase"), [0.91, 0.91]),
        recoveries("plain", "other", [0.30, 0.31]),
    )
    _, [row] = recovery_table(SUITE, results)
    assert [cell.startswith("**") for cell in row[1:]] == [True, False, False]


RESULTS = table(
    ("plain", "popl", "upper", "accuracy", [0.90, 0.92]),
    ("plain", "popl", "upper", "best_accuracy", [0.95, 0.95]),
    ("plain", ("popl", "lexicase"), "upper", "accuracy", [0.5, 0.5]),
    ("plain", ("popl", "lexicase"), "upper", "best_accuracy", [0.95, 0.95]),
    ("plain", "oracle", "upper", "accuracy", [0.98, 0.98]),
    ("plain", "oracle", "upper", "best_accuracy", [0.98, 0.98]),
    ("plain", "popl", "all", "seconds", [10.0, 20.0]),
    ("base", "popl", "upper", "accuracy", [0.8]),
    ("base", "other", "upper", "accuracy", [0.7]),
    ("noisy", "popl", "upper", "accuracy", [0.6]),
)


def test_accuracies_by_scenario_and_along_each_axis():
    """Two seeds 0.02 apart: half-width 12.706 * 0.01 (t, one degree) = 12.7 percent."""
    text = benchmark_markdown(SUITE, RESULTS, about={"seeds": 2}, missing={}, figures=[])
    rows = lines(text)
    assert "| seeds | 2 |" in rows
    head = "| scenario | raters who want | popl | popl, by lexicase | oracle (told the groups) |"
    assert head in rows
    assert "| plain | upper | 91.0 ± 12.7 (95.0 ± 0.0) | 50.0 ± 0.0 | 98.0 ± 0.0 |" in rows
    assert "## Axis: noise" in text
    assert "| method | raters who want | 0 | 0.1 |" in rows
    assert "| popl | upper | 80.0 | 60.0 |" in rows
    assert not [row for row in rows if row.startswith("| other | upper")], "only at one point"
    assert "| popl | none | 15 |" in rows
    assert "| other | `method=popl_published` | – |" in rows
    assert "| base | `data.length=5` |" in rows
    assert "those of all cells: `env.max_steps=9`" in text
    assert "Missing cells" not in text
    assert "worst-served" not in text, "no recovery is known"


def test_the_report_has_a_row_for_each_method_and_a_column_for_each_scenario_off_the_axes():
    """Two seeds 0.02 apart: half-width 12.706 * 0.01 (t, one degree) = 0.13."""
    results = table(
        recoveries("plain", "popl", [0.90, 0.92]),
        recoveries("plain", "pooled_cpl", [0.1, 0.1]),
        recoveries("base", "popl", [0.9]),
        recoveries("noisy", "popl", [0.8]),
        recoveries("noisy", "other", [0.7]),
    )
    rows = lines(benchmark_markdown(SUITE, results, about={}, missing={}, figures=[]))
    start = rows.index("| method | plain |")
    assert rows[start + 1 : start + 3] == [
        "| popl | **0.91 ± 0.13 [0.90]** |",
        "| CPL on everybody's answers | 0.10 ± 0.00 [0.10] |",
    ]
    start = rows.index("| method | 0 | 0.1 |")
    assert rows[start + 1] == "| popl | 0.90 | 0.80 |"
    assert not rows[start + 2].startswith("| other"), "only at one point"


def test_the_share_of_optimum_is_the_headline_of_scenarios_that_know_it():
    """The oracle has a share of its own then, but is not what others could be better than."""
    results = table(
        recoveries("plain", "popl", [2.0]),
        ("plain", "popl", "upper", "share_of_optimum", [0.6]),
        ("plain", "popl", "lower", "share_of_optimum", [0.5]),
        ("plain", "oracle", "upper", "share_of_optimum", [0.7]),
        ("plain", "random", "upper", "share_of_optimum", [0.0]),
        recoveries("base", "popl", [0.9]),
    )
    head, rows = recovery_table(SUITE, results)
    assert head == ["scenario", "popl", "oracle (told the groups)"]
    assert rows == [["plain", "0.50", "0.70"], ["base", "0.90", "–"]]
    text = benchmark_markdown(SUITE, results, about={}, missing={}, figures=[])
    assert "Share of optimum (recovery in base) of the group with the lowest, by method" in text


def test_what_a_set_holds_and_how_much_of_it_is_found():
    """Seed 0: gaps of 1.0 - 0.9 and 0.8 - 0.75, at 10 answers 0.3 and 0.05. Seed 1: 0 and 0.2, and
    0.1 and 0.1. The largest are 0.1 and 0.2; 0.3 and 0.1. The best in hindsight of the worst group:
    0.8 and 0.9."""
    results = table(
        ("plain", "popl", "upper", "recovery", [0.9, 1.0]),
        ("plain", "popl", "upper", "recovery@10", [0.7, 0.9]),
        ("plain", "popl", "upper", "best_recovery", [1.0, 1.0]),
        ("plain", "popl", "lower", "recovery", [0.75, 0.7]),
        ("plain", "popl", "lower", "recovery@10", [0.75, 0.8]),
        ("plain", "popl", "lower", "best_recovery", [0.8, 0.9]),
        ("plain", "popl", "all", "coverage", [1.0, 1.0]),
        ("plain", "popl", "all", "effective", [2.0, 2.0]),
        ("plain", "popl", "all", "fair_worst_rater", [0.2, 0.2]),
        ("plain", "popl", "all", "fair_quantile", [0.4, 0.4]),
        ("plain", "pooled_cpl", "upper", "recovery", [0.1, 0.1]),
        ("plain", "other", "upper", "best_recovery", [0.5]),
    )
    head, rows = catering_table(SUITE, results)
    assert len(head) == len(rows[0])
    # Half-widths are 12.706 times half the distance.
    assert rows == [
        [
            *("plain", "popl", "1.00 ± 0.00", "0.85 ± 0.64", "0.15 ± 0.64", "0.20 ± 1.27"),
            *("2.00 ± 0.00", "0.20 ± 0.00 (0.40 ± 0.00)"),
        ],
        ["plain", "other", "–", "0.50", "–", "–", "–", "– (–)"],
    ]


def test_axes_of_many_groups_are_told_by_recovery_alone(tmp_path):
    names = [f"group_{number}" for number in range(5)]
    rows = [
        (scenario, "popl", name, measure, [0.5])
        for scenario in ("base", "noisy")
        for name in names
        for measure in ("accuracy", "recovery")
    ]
    cells = plan(SUITE, seeds=1)
    write_report(tmp_path, SUITE, cells, table(*rows), {})
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["axes.png"]
    text = (tmp_path / "report.md").read_text()
    assert "| popl | 0.50 | 0.50 |" in text
    assert "| popl | group_0 |" not in text


def test_what_is_missing_is_said_on_a_line_each():
    missing = {"plain/popl/seed0": "two\n  lines", "plain/popl/seed1": "not run yet"}
    text = benchmark_markdown(SUITE, RESULTS, about={"seeds": 2}, missing=missing, figures=[])
    assert "## Missing cells: 2\n\n- plain/popl/seed0: two lines\n- plain/popl/seed1: not" in text


def finish(cell, run_dir, commit):
    folder = cell.folder(run_dir)
    folder.mkdir(parents=True)
    git = None if commit is None else {"commit": commit, "dirty": True}
    about = {"versions": {"popl_rl": "1.0"}, "git": git}
    (folder / "metadata.json").write_text(json.dumps(about))
    (folder / "cell.json").write_text(json.dumps(cell.record()))
    (folder / "results.csv").touch()


def test_a_report_is_written_with_results_and_pictures(tmp_path):
    cells = plan(SUITE, seeds=2)
    finish(cells[0], tmp_path, "abcdefghij")
    finish(cells[1], tmp_path, "abcdefghij")
    finish(cells[2], tmp_path, None)
    results = pd.concat([RESULTS, table(recoveries("plain", "popl", [0.9, 0.8]))])
    write_report(tmp_path, SUITE, cells, results, {cells[3].name: "a reason"})
    assert pd.read_csv(tmp_path / "results.csv").value.tolist() == results.value.tolist()
    text = (tmp_path / "report.md").read_text()
    assert "| cells | 3 of 12 |" in text
    assert "| code | popl_rl 1.0, popl_rl 1.0 abcdefg and changes |" in text
    assert f"- {cells[3].name}: a reason" in text
    assert f"- {cells[4].name}: not run yet" in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "recovery.png",
        "sweeps.png",
    }
    assert "![recovery](figures/recovery.png)" in text
    assert "![sweeps](figures/sweeps.png)" in text


def test_a_report_of_nothing_leaves_no_old_pictures(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "recovery.png").touch()
    cells = plan(SUITE, seeds=1)
    write_report(tmp_path, SUITE, cells, pd.DataFrame(columns=COLUMNS), {})
    assert "## Missing cells: 6" in (tmp_path / "report.md").read_text()
    assert not list((tmp_path / "figures").iterdir())
