import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from popl_rl.experiments.cells import COLUMNS
from popl_rl.experiments.suites import parse_suite
from popl_rl.plotting.benchmark_plots import scenario_bars, sweep_panels

SUITE = parse_suite(
    "mine",
    {
        "methods": {"popl": [], "other": []},
        "scenarios": {
            "plain_one": {"overrides": [], "at": {"size": 10, "kind": "plain"}},
            "large": {"overrides": ["data.length=5"], "at": {"size": 1000}},
            "odd": {"overrides": ["raters=minority"], "at": {"kind": "odd"}},
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


def texts(fig):
    return " ".join(text.get_text() for text in [*fig.texts, *fig.legends[0].get_texts()])


def assert_nothing_overlaps_the_edge(fig):
    fig.draw_without_rendering()
    box = fig.get_tightbbox()
    assert box.x0 > -0.02
    assert box.y0 > -0.02
    assert box.x1 < fig.get_figwidth() + 0.02
    assert box.y1 < fig.get_figheight() + 0.02


RECOVERIES = table(
    ("plain_one", "popl", "upper", "recovery", [0.8, 0.9, 1.0]),
    ("plain_one", "popl", "lower", "recovery", [1.0, 1.0, 1.0]),
    ("plain_one", ("popl", "lexicase"), "upper", "recovery", [0.7]),
    ("plain_one", "pooled_cpl", "upper", "recovery", [-3.0, -3.0]),
    ("plain_one", "oracle", "upper", "recovery", [1.0]),
    ("odd", "popl", "upper", "recovery", [0.5, np.nan]),
)


def test_a_bar_for_each_scenario_and_method_with_its_interval_and_seeds():
    """Standard error of 0.8, 0.9, 1.0 is 0.1 / sqrt(3); times 4.303 (t, two degrees): 0.2484."""
    fig = scenario_bars(SUITE, RECOVERIES)
    (ax,) = fig.axes
    width = 0.84 / 3
    heights = {round(bar.get_x() + bar.get_width() / 2, 3): bar.get_height() for bar in ax.patches}
    expected = {-width: 0.9, 0: 0.7, width: -0.5, 1 - width: 0.5}
    assert heights == pytest.approx({round(x, 3): height for x, height in expected.items()})
    bars = [lines.get_segments()[0] for lines in ax.collections if hasattr(lines, "get_segments")]
    assert np.asarray(bars[0])[:, 1] == pytest.approx([0.9 - 0.2484, 0.9 + 0.2484], abs=1e-4)
    dots = [drawn.get_offsets()[:, 1] for drawn in ax.collections if len(drawn.get_offsets()) > 1]
    assert dots[0].tolist() == [0.8, 0.9, 1.0]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["plain\none", "odd"]
    for words in ("popl, by lexicase", "CPL on everybody's answers", "worst-served"):
        assert words in texts(fig)
    assert "oracle (told" not in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_bars_need_recoveries():
    with pytest.raises(ValueError, match="must hold the recovery of some method"):
        scenario_bars(SUITE, RECOVERIES[RECOVERIES.method == "oracle"])


ACCURACIES = table(
    *(
        (scenario, method, group, measure, [value, value + 0.1])
        for scenario, value in (("plain_one", 0.6), ("large", 0.7), ("odd", 0.8))
        for method in ("popl", "other", ("popl", "lexicase"), "oracle", "bradley_terry", "brex")
        for group in ("upper", "lower")
        for measure in ("accuracy", "best_accuracy")
        if (scenario, method)
        not in (("odd", "other"), ("odd", "bradley_terry"), ("large", "oracle"))
    )
)


def curves(ax):
    """Points of the curves in a panel, without the line of guessing across it."""
    return [line.get_xydata().tolist() for line in ax.lines if line.get_linestyle() != ":"]


def test_a_panel_for_each_axis_and_group_with_the_methods_that_run_along_it():
    fig = sweep_panels(SUITE, ACCURACIES)
    assert len(fig.axes) == 4
    assert [ax.get_xlabel() for ax in fig.axes] == ["", "", "size", "kind"]
    size, kind = fig.axes[:2]
    assert size.get_ylabel() == "accuracy on\n“upper”"
    assert len(curves(size)) == 6, "accuracy and best of three; the oracle has one point"
    assert curves(size)[0] == [pytest.approx([1, 0.65]), pytest.approx([3, 0.75])], "logarithms"
    assert len(curves(kind)) == 4, "popl and the oracle"
    assert [point[0] for point in curves(kind)[0]] == [0, 1], "words in their order"
    assert [label.get_text() for label in fig.axes[2].get_xticklabels()] == ["10", "1000"]
    assert [label.get_text() for label in fig.axes[3].get_xticklabels()] == ["plain", "odd"]
    assert len(size.collections) == 3, "bands of what raters are given"
    assert "brex" not in texts(fig)
    assert "by lexicase" not in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_methods_have_the_same_colours_in_both_figures():
    bar = scenario_bars(SUITE, RECOVERIES).axes[0].patches[0]
    line = sweep_panels(SUITE, ACCURACIES).axes[0].lines[0]
    assert to_hex(bar.get_facecolor()) == to_hex(line.get_color())


def test_many_methods_are_told_apart_by_colour_or_marker():
    names = [f"method_{number}" for number in range(8)]
    suite = parse_suite(
        "mine",
        {
            "methods": {name: [] for name in names},
            "scenarios": {
                "a": {"overrides": [], "at": {"x": 0}},
                "b": {"overrides": ["data.length=5"], "at": {"x": 1}},
            },
        },
    )
    rows = [(s, name, "g", "accuracy", [0.5]) for s in ("a", "b") for name in names]
    handles = sweep_panels(suite, table(*rows)).legends[0].legend_handles
    assert len({(handle.get_color(), handle.get_marker()) for handle in handles}) == 8


def test_panels_need_two_points_of_an_axis():
    with pytest.raises(ValueError, match="accuracies at two points of an axis, got none"):
        sweep_panels(SUITE, ACCURACIES[ACCURACIES.scenario == "large"])
