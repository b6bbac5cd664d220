import io
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from popl_rl.evaluation.statistics import RESULT_COLUMNS, summary, worst_group
from popl_rl.experiments.report import markdown, print_results, results_table, verdict_lines

RESULTS = pd.DataFrame(
    [
        ("random", "", "upper", "return", -5.0),
        ("pooled_cpl", "", "upper", "recovery", 0.97),
        ("pooled_cpl", "", "lower", "recovery", 0.3),
        ("popl", "posterior", "upper", "return", 4.5),
        ("popl", "posterior", "upper", "recovery", 0.95),
        ("popl", "posterior", "upper", "success", 0.987),
        ("popl", "posterior", "upper", "accuracy", 0.88),
        ("popl", "posterior", "upper", "door_0", 1.0),
        ("popl", "posterior", "lower", "recovery", -0.001),
        ("mine", "", "[red]", "accuracy", 0.5),
        ("oracle", "", "upper", "recovery", 1.0),
    ],
    columns=RESULT_COLUMNS,
)


def printed(results: pd.DataFrame) -> list[list[str]]:
    """The cells of the printed table, header first."""
    screen = io.StringIO()
    Console(file=screen, width=120).print(results_table(results))
    lines = [line.replace("┃", "│") for line in screen.getvalue().splitlines()]
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]


def test_the_table_has_a_row_for_each_method_and_group() -> None:
    assert printed(RESULTS) == [
        ["method", "raters who want", "return", "recovery", "success", "accuracy"],
        ["POPL (catered)", "upper", "4.50", "0.95", "99 %", "88 %"],
        ["", "lower", "–", "0.00", "–", "–"],
        ["CPL on everybody's answers", "upper", "–", "0.97", "–", "–"],
        ["", "lower", "–", "0.30", "–", "–"],
        ["oracle (told the groups)", "upper", "–", "1.00", "–", "–"],
        ["random actions", "upper", "−5.00", "–", "–", "–"],
        ["mine", "[red]", "–", "–", "–", "50 %"],
    ]


def test_several_runs_are_shown_with_their_interval() -> None:
    results = pd.DataFrame(
        [("popl", "posterior", "a", "recovery", value) for value in (0.8, 0.9, 1.0)]
        + [("popl", "posterior", "a", "success", value) for value in (0.5, float("nan"))],
        columns=RESULT_COLUMNS,
    )
    # Standard error 0.1 / sqrt(3), times the 97.5 % point of t with 2 degrees of freedom, 4.303.
    assert printed(results)[1] == ["POPL (catered)", "a", "–", "0.90 ± 0.25", "50 %", "–"]


def test_the_worst_group_counts() -> None:
    assert worst_group(RESULTS) == {
        ("popl", "posterior"): -0.001,
        ("pooled_cpl", ""): 0.3,
        ("oracle", ""): 1.0,
    }
    unknown = RESULTS.assign(value=RESULTS["value"].where(RESULTS["group"] != "lower"))
    assert worst_group(unknown) == {("oracle", ""): 1.0}, "what is unknown in a group has no worst"


def test_the_report_has_everything() -> None:
    text = markdown(
        RESULTS,
        title="Two doors",
        about={"groups": "upper | lower", "seed": 0},
        figures=[Path("figures/learning_curves.png"), Path("figures/a b.png")],
        label="popl",
    )
    lines = text.splitlines()
    assert lines[0] == "# Two doors"
    assert "| groups | upper \\| lower |" in lines
    assert "| seed | 0 |" in lines
    assert "| POPL (catered) | upper | 4.50 | 0.95 | 99 % | 88 % |" in lines
    assert "| random actions | upper | −5.00 | – | – | – |" in lines
    assert "![learning curves](figures/learning_curves.png)" in lines
    assert "![a b](figures/a%20b.png)" in lines
    worst = "Recovery of the worst-served group: POPL (catered) **0.00**, "
    assert f"{worst}CPL on everybody's answers **0.30**." in lines
    for word in ("recovery", "oracle", "accuracy", "success", "return", "group"):
        assert any(line.startswith(f"- **{word}**: ") for line in lines)
    assert text.endswith(".\n")


def test_the_share_of_optimum_takes_the_place_of_recovery_where_it_is_known() -> None:
    shares = RESULTS[RESULTS["measure"] == "recovery"].assign(measure="share_of_optimum")
    results = pd.concat([RESULTS, shares])
    assert printed(results)[0] == [
        *("method", "raters who want", "return", "share of optimum", "success", "accuracy")
    ]
    text = markdown(results, title="t", about={}, figures=[], label="popl")
    worst = "Share of optimum of the worst-served group: POPL (catered) **0.00**, "
    assert f"{worst}CPL on everybody's answers **0.30**, oracle (told the groups) **1.00**." in text


def test_the_report_does_without_baselines_and_pictures() -> None:
    results = RESULTS[RESULTS["measure"] == "accuracy"]
    text = markdown(results, title="t", about={}, figures=[], label="popl")
    assert "Recovery of the worst" not in text
    assert "![" not in text


def test_pictures_must_be_relative() -> None:
    with pytest.raises(ValueError, match=r"figures must be relative .*got \['/a\.png'\]"):
        markdown(RESULTS, title="t", about={}, figures=[Path("/a.png")], label="popl")


def test_a_missing_column_is_named() -> None:
    bad = RESULTS.drop(columns="group")
    with pytest.raises(ValueError, match=r"\['group'\] are missing"):
        results_table(bad)
    with pytest.raises(ValueError, match=r"\['group'\] are missing"):
        worst_group(bad)
    with pytest.raises(ValueError, match=r"\['group'\] are missing"):
        markdown(bad, title="t", about={}, figures=[], label="popl")


def test_a_summary_is_about_the_worst_group_of_each_run():
    """Worst recoveries 0.8 and 0.6: mean 0.7, half-width 12.706 * 0.1 (t, one degree)."""

    def results(upper, lower, accuracy):
        rows = [
            ("popl", "posterior", "upper", "recovery", upper),
            ("popl", "posterior", "lower", "recovery", lower),
            ("popl", "posterior", "upper", "accuracy", accuracy),
            ("oracle", "", "upper", "accuracy", 0.9),
        ]
        return pd.DataFrame(rows, columns=RESULT_COLUMNS)

    table = summary({"a": results(0.8, 1.0, 0.88), "b": results(0.9, 0.6, 0.85)})
    row = table.set_index("method").loc["popl"]
    assert row.runs == 2
    assert row.worst_recovery == pytest.approx(0.7)
    assert row.worst_recovery_ci == pytest.approx(12.706 * 0.1, rel=1e-3)
    assert row.worst_recovery_min == pytest.approx(0.6)
    assert row.accuracy_gap == pytest.approx(0.05)


def test_verdicts_come_first_in_the_report_and_on_the_terminal() -> None:
    returns = {("popl", "posterior"): 95.0, ("oracle", ""): 100.0, ("random", ""): 0.0}
    rows = [
        (*entry, group, measure, number)
        for entry, value in returns.items()
        for group, worth in (("fast", value), ("slow", 0.1 * value if entry[1] else value))
        for measure, number in (("return", worth), ("return_error", 1.0))
    ]
    results = pd.DataFrame(rows, columns=RESULT_COLUMNS)
    first = markdown(results, title="t", about={"seed": 0}, figures=[], label="popl").splitlines()
    assert first[2].startswith("- **fast**: served (0.95 [0.9")
    assert first[3].startswith("- **slow**: not found (")
    fast, slow = verdict_lines(results, "popl")
    assert (fast.style, slow.style) == ("green", "red")
    assert fast.plain.startswith("fast: served")


def test_what_is_wrong_alarms_and_leaving_the_data_warns() -> None:
    rows = [
        ("popl", "posterior", "upper", "recovery", 0.9),
        ("popl", "posterior", "upper", "inside_data", 0.5),
    ]
    screen = io.StringIO()
    print_results(
        Console(file=screen, width=200), pd.DataFrame(rows, columns=RESULT_COLUMNS), "popl"
    )
    assert "warning: " in screen.getvalue()
    assert "50% for upper of their steps" in screen.getvalue()
    assert "alarm: " not in screen.getvalue()
