import pandas as pd
import pytest

from popl_rl.evaluation.diagnostics import alarm


def results(gain, error):
    values = {"gain": gain, "gain_error": error, "favourite_share": 0.97, "effective": 1.04}
    rows = [("popl", "all", measure, value) for measure, value in values.items()]
    other = [("brex", "all", "gain", 9.0), ("popl", "upper", "recovery", 1.0)]
    return pd.DataFrame(rows + other, columns=["method", "group", "measure", "value"])


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
