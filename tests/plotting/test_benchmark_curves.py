import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from popl_rl.experiments.cells import COLUMNS
from popl_rl.experiments.suites import parse_suite
from popl_rl.plotting.benchmark_curves import catering_curves, recovery_along_axes, scenario_dots
from popl_rl.plotting.benchmark_plots import scenario_bars

SUITE = parse_suite(
    "mine",
    {
        "methods": {"popl": [], "other": []},
        "scenarios": {
            "plain": [],
            "odd": ["raters=minority"],
            "small": {"overrides": ["data.length=4"], "at": {"size": 10, "kind": "plain"}},
            "large": {"overrides": ["data.length=5"], "at": {"size": 1000}},
            "wild": {"overrides": ["data.length=6"], "at": {"kind": "wild"}},
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


def curve_rows(scenario, method, values, best):
    """The other group is served perfectly: what is drawn is the worst."""
    rows = [
        (scenario, method, group, f"recovery@{answers}", [value, value - 0.1])
        for answers, value in values.items()
        for group, value in (("upper", value), ("lower", 1.1))
    ]
    return [*rows, (scenario, method, "upper", "best_recovery", [best, best])] if best else rows


CURVES = table(
    *curve_rows("plain", "popl", {1: 0.5, 10: 0.8, 100: 0.9}, 0.95),
    *curve_rows("plain", ("popl", "lexicase"), {1: 0.3, 10: 0.6}, None),
    *curve_rows("plain", "other", {10: -3.0}, -3.0),
    *curve_rows("odd", "popl", {1: 0.4}, 0.4),
    ("plain", "pooled_cpl", "upper", "recovery", [0.1]),
)


def curves(ax):
    """Points of what is no straight line across the panel, by look."""
    lines = [line for line in ax.lines if line.get_linestyle() != "--"]
    return [line.get_xydata() for line in lines]


def assert_nothing_overlaps_the_edge(fig):
    fig.draw_without_rendering()
    box = fig.get_tightbbox()
    assert box.x0 > -0.02
    assert box.y0 > -0.02
    assert box.x1 < fig.get_figwidth() + 0.02
    assert box.y1 < fig.get_figheight() + 0.02


def test_curves_of_catering_and_the_best_in_hindsight():
    fig = catering_curves(SUITE, CURVES)
    assert len(fig.axes) == 4, "two scenarios, two kinds of catering"
    posterior, lexicase = fig.axes[:2]
    popl, dotted, best, other, _, cut = curves(posterior)
    assert popl == pytest.approx(np.array([[0, 0.45], [1, 0.75], [2, 0.85]]))
    assert best == pytest.approx(np.array([[2.35, 0.95]]))
    assert dotted == pytest.approx(np.array([[2, 0.85], [2.35, 0.95]]))
    assert other == pytest.approx(np.array([[1, -0.5]])), "cut off"
    assert cut == pytest.approx(np.array([[2.35, -0.5]]))
    assert curves(lexicase)[0] == pytest.approx(np.array([[0, 0.25], [1, 0.55]]))
    labels = [label.get_text() for label in fig.axes[2].get_xticklabels()]
    assert labels == ["1", "10", "100", "best"]
    assert [text.get_text() for text in fig.legends[0].get_texts()] == ["popl", "other"]
    assert_nothing_overlaps_the_edge(fig)


def test_chosen_questions_have_a_panel_beside_drawn_ones():
    asked = table(*curve_rows("plain", ("popl", "information_gain"), {1: 0.9, 10: 0.95}, None))
    fig = catering_curves(SUITE, pd.concat([CURVES, asked]))
    titles = [ax.get_title() for ax in fig.axes[:3]]
    assert titles == ["posterior catering", "posterior, questions chosen", "lexicase catering"]
    assert curves(fig.axes[1])[0] == pytest.approx(np.array([[0, 0.85], [1, 0.9]]))
    assert_nothing_overlaps_the_edge(fig)


def test_curves_need_curves():
    with pytest.raises(ValueError, match="measures such as recovery@10, got none"):
        catering_curves(SUITE, CURVES[CURVES.method == "pooled_cpl"])
    # As with evaluation.curve=[], where the best member alone is known.
    with pytest.raises(ValueError, match="measures such as recovery@10, got none"):
        catering_curves(SUITE, CURVES[CURVES.measure.str.startswith("best_")])


RECOVERIES = table(
    *(
        (scenario, method, "upper", "recovery", [value, value + 0.1])
        for scenario, value in (("plain", 0.6), ("small", 0.7), ("large", 0.8), ("wild", -2.0))
        for method in ("popl", ("popl", "lexicase"), "other", "pooled_cpl", "oracle")
        if (scenario, method)
        not in (("wild", "other"), ("large", "pooled_cpl"), ("wild", "pooled_cpl"))
    )
)


def test_dots_of_scenarios_and_methods():
    fig = scenario_dots(SUITE, RECOVERIES[RECOVERIES.scenario.isin(["plain", "wild"])])
    plain, wild = fig.axes
    assert [label.get_text() for label in plain.get_yticklabels()] == [
        "popl",
        "other",
        "CPL on everybody's answers",
    ]
    means = [line.get_xydata()[0] for line in plain.lines if len(line.get_xdata()) == 1]
    assert np.array(means) == pytest.approx(np.array([[0.65, 0], [0.65, 1], [0.65, 2]]))
    means = [line.get_xydata()[0] for line in wild.lines if len(line.get_xdata()) == 1]
    assert np.array(means) == pytest.approx(np.array([[-0.5, 0]])), "cut off"
    assert_nothing_overlaps_the_edge(fig)


def test_a_method_has_one_colour_in_all_figures():
    dots = scenario_dots(SUITE, RECOVERIES).axes[0].lines[0].get_color()
    bars = scenario_bars(SUITE, RECOVERIES).axes[0].patches[0].get_facecolor()
    lines = recovery_along_axes(SUITE, RECOVERIES).axes[0].lines[0].get_color()
    assert to_hex(dots) == to_hex(bars) == to_hex(lines)


def test_dots_need_recoveries():
    with pytest.raises(ValueError, match="recovery of some method in every group, got none"):
        scenario_dots(SUITE, RECOVERIES[RECOVERIES.method == "oracle"])


def test_a_panel_for_each_axis_with_the_methods_that_run_along_it():
    fig = recovery_along_axes(SUITE, RECOVERIES)
    size, kind = fig.axes
    assert (size.get_xlabel(), kind.get_xlabel()) == ("size", "kind")
    assert [points.tolist() for points in curves(size)] == [
        [pytest.approx([1, 0.75]), pytest.approx([3, 0.85])] for _ in ("popl", "other")
    ]
    assert [label.get_text() for label in kind.get_xticklabels()] == ["plain", "wild"]
    assert curves(kind)[0] == pytest.approx(np.array([[0, 0.75], [1, -0.5]]))
    assert len(curves(kind)) == 1, "others have one point"
    assert_nothing_overlaps_the_edge(fig)


def test_axes_need_two_points():
    with pytest.raises(ValueError, match="recoveries at two points of an axis, got none"):
        recovery_along_axes(SUITE, RECOVERIES[RECOVERIES.scenario == "small"])
