import pandas as pd
import pytest

from popl_rl.experiments.tables import COLUMNS, WinsTable, read_tables, rows_for


def rows_of(method, by_scenario, *, measure="recovery", group="a"):
    """Rows of one group; values are those of seeds 0, 1, ..."""
    return [
        ("s", scenario, seed, method, "", group, measure, value)
        for scenario, values in by_scenario.items()
        for seed, value in enumerate(values)
    ]


def table(methods, scenarios, **options):
    return WinsTable(
        "s",
        ["share_of_optimum", "recovery"],
        ("mine", ""),
        {(name, ""): name for name in methods},
        {name: name for name in scenarios},
        **options,
    )


def test_wins_ties_and_losses_are_told_together():
    """Differences 0.5, 0.51, 0.52 (p 0.0001), −0.4, −0.41, −0.42 (0.0002), 0.1, 0.2, 0.3 (0.07)."""
    mine = [0.8, 0.8, 0.8]
    rows = rows_of("mine", {"one": mine, "two": mine, "three": mine, "four": [0.8]})
    rows += rows_of("weak", {"one": [0.3, 0.29, 0.28], "two": [1.2, 1.21, 1.22]})
    rows += rows_of("weak", {"three": [0.7, 0.6, 0.5], "four": [0.1]})
    results = pd.DataFrame(rows, columns=COLUMNS)
    text = table(["weak"], ["one", "two", "three", "four"]).markdown(results)
    # t(0.975, 2) = 4.303, so 0.02 for a standard deviation of 0.01; one seed is not counted.
    expected = "| weak | 0.51 ± 0.02 ▲ | −0.41 ± 0.02 ▼ | 0.20 ± 0.25 | 0.70 | 1 / 1 / 1 |"
    assert text.splitlines()[-1] == expected


def test_an_interval_apart_from_0_is_a_tie_among_many():
    """Differences of 0.1, 0.12 and 0.15 have p = 0.014: enough alone, too much for four cells."""
    mine, other = {"one": [0.6, 0.62, 0.65]}, {"one": [0.5, 0.5, 0.5]}
    for name in ("two", "three", "four"):
        mine[name], other[name] = [0.5, 0.6, 0.0], [0.4, 0.8, 0.0]
    rows = rows_of("mine", mine) + rows_of("other", other)
    results = pd.DataFrame(rows, columns=COLUMNS)
    text = table(["other"], list(mine)).markdown(results)
    assert "| 0.12 ± 0.06 △ |" in text
    assert text.endswith("| 0 / 4 / 0 |")
    assert "0.12 ± 0.06 ▲ | 1 / 0 / 0 |" in table(["other"], ["one"]).markdown(results)


def test_a_scenario_is_judged_by_the_first_measure_that_it_has():
    rows = [
        *rows_of("mine", {"known": [0.9]}, measure="share_of_optimum"),
        *rows_of("mine", {"known": [0.1], "unknown": [0.7]}),
        *rows_of("other", {"known": [0.4]}, measure="share_of_optimum"),
        *rows_of("other", {"known": [0.3], "unknown": [0.5]}),
    ]
    results = pd.DataFrame(rows, columns=COLUMNS)
    made = table(["other", "never run"], ["known", "unknown"])
    assert made.markdown(results).splitlines()[-2:] == [
        "| other | 0.50 | 0.20 | 0 / 0 / 0 |",
        "| never run | – | – | 0 / 0 / 0 |",
    ]
    kept = rows_for({"t": made}, results)
    assert kept[["scenario", "measure"]].drop_duplicates().values.tolist() == [
        ["known", "share_of_optimum"],
        ["unknown", "recovery"],
    ]


@pytest.mark.parametrize(("over", "expected"), [("worst", "0.10"), ("mean", "0.20")])
def test_of_which_group(over, expected):
    rows = rows_of("mine", {"one": [0.5]}) + rows_of("mine", {"one": [0.9]}, group="b")
    rows += rows_of("other", {"one": [0.4]}) + rows_of("other", {"one": [0.6]}, group="b")
    text = table(["other"], ["one"], over=over).markdown(pd.DataFrame(rows, columns=COLUMNS))
    assert text.splitlines()[-1] == f"| other | {expected} | 0 / 0 / 0 |"


def test_it_is_described_in_a_file(tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(
        '[t]\nsuite = "s"\nmeasures = ["share_of_optimum", "recovery"]\nwins_of = ["mine", ""]\n'
        'methods = [["other", "", "other"]]\nscenarios = {one = "one"}\n'
    )
    assert read_tables(path) == {"t": table(["other"], ["one"])}
