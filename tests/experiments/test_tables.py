import pandas as pd
import pytest

from popl_rl.experiments.tables import ResultTable, fill_tables

COLUMNS = ["suite", "scenario", "seed", "method", "choice", "group", "measure", "value"]


def test_a_cell_is_the_worst_group_over_seeds():
    """Worst groups 0.4 and 0.6: mean 0.5, standard error 0.1, t(0.975, 1) = 12.706."""
    rows = [
        ("s", "two", seed, "popl", "", group, "recovery", value)
        for seed, group, value in [(0, "a", 0.4), (0, "b", 0.9), (1, "a", 0.8), (1, "b", 0.6)]
    ]
    table = ResultTable("recovery", {("popl", ""): "`popl`"}, {"two": "two", "three": "three"})
    lines = table.markdown(pd.DataFrame(rows, columns=COLUMNS)).splitlines()
    assert lines[-1] == "| `popl` | 0.50 ± 1.27 [0.40] | – |"


def test_marked_tables_are_replaced_and_nothing_else():
    text = "before\n<!-- table: t -->\nold\n<!-- end -->\nafter\n"
    filled = fill_tables(text, {"t": "| new |"})
    assert filled == "before\n<!-- table: t -->\n| new |\n<!-- end -->\nafter\n"
    assert fill_tables(filled, {"t": "| new |"}) == filled


def test_an_unknown_table_is_named():
    with pytest.raises(ValueError, match="'u'"):
        fill_tables("<!-- table: u -->\n<!-- end -->", {"t": ""})
