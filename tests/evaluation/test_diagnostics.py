import pandas as pd
import pytest

from popl_rl.evaluation.diagnostics import alarm, weak_oracles
from popl_rl.evaluation.statistics import RESULT_COLUMNS


def results(gain, error):
    values = {"gain": gain, "gain_error": error, "favourite_share": 0.97, "effective": 1.04}
    rows = [("popl", "", "all", measure, value) for measure, value in values.items()]
    other = [("brex", "", "all", "gain", 9.0), ("popl", "posterior", "upper", "recovery", 1.0)]
    return pd.DataFrame(rows + other, columns=RESULT_COLUMNS)


@pytest.mark.parametrize(
    ("gain", "error"), [(0.01, 0.006), (-0.04, 0.001), (0.0, 0.0), (0.2, float("nan"))]
)
def test_the_alarm_sounds_where_catering_gains_nothing(gain, error):
    said = alarm(results(gain, error))
    assert said is not None
    assert f"({100 * gain:+.1f} ± {200 * error:.1f} points; 97% of raters" in said
    assert "effectively 1.0 members" in said


def test_it_is_silent_where_catering_gains_something():
    assert alarm(results(0.013, 0.006)) is None


def test_it_is_silent_where_nothing_was_measured():
    assert alarm(results(0.0, 0.0).query("group != 'all'")) is None


def test_oracles_far_from_the_optimum_are_flagged():
    """The line is at 0.8; a group without a known share, and another method, are no reason."""
    shares = {"upper": 0.79, "lower": 0.8, "odd": float("nan")}
    rows = [("oracle", "", group, "share_of_optimum", value) for group, value in shares.items()]
    rows += [("popl", "posterior", "upper", "share_of_optimum", 0.1)]
    found = pd.DataFrame(rows, columns=RESULT_COLUMNS)
    assert "share of the optimum of only 0.79 for upper: a recovery of 1" in weak_oracles(found)
    assert weak_oracles(found[found.group != "upper"]) is None
