import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from popl_rl.evaluation.statistics import RESULT_COLUMNS
from popl_rl.plotting.recovery_plots import recovery_bars
from popl_rl.plotting.style import PALETTE


def texts(fig: Figure) -> str:
    """Everything that can be read in a figure."""
    found = [text.get_text() for text in fig.texts]
    for ax in fig.axes:
        found += [ax.get_title(), ax.get_xlabel(), ax.get_ylabel()]
        found += [text.get_text() for text in ax.texts]
    for legend in fig.legends:
        found += [text.get_text() for text in legend.get_texts()]
    return "\n".join(found).replace("\n", " ")


def assert_nothing_overlaps_the_edge(fig: Figure) -> None:
    fig.draw_without_rendering()
    box = fig.get_tightbbox()
    assert box.x0 > -0.02
    assert box.y0 > -0.02
    assert box.x1 < fig.get_figwidth() + 0.02
    assert box.y1 < fig.get_figheight() + 0.02


def dots(ax: Axes) -> list[PathCollection]:
    return [drawn for drawn in ax.collections if isinstance(drawn, PathCollection)]


def points(drawn: PathCollection) -> NDArray[np.float64]:
    return np.asarray(drawn.get_offsets())


def bars(ax: Axes) -> list[Rectangle]:
    return [patch for patch in ax.patches if isinstance(patch, Rectangle)]


def tidy(values: dict[tuple[str, str], list[float]], measure: str = "recovery") -> pd.DataFrame:
    """Rows from values by method and group; what POPL gives is catered by the posterior."""
    rows = [
        (method, "posterior" if method == "popl" else "", group, measure, value)
        for (method, group), found in values.items()
        for value in found
    ]
    rows += [("popl", "posterior", "upper", "return", 100.0)]
    return pd.DataFrame(rows, columns=RESULT_COLUMNS)


def test_recovery_is_a_bar_for_each_method_and_group_between_random_and_oracle() -> None:
    results = tidy(
        {
            ("pooled_cpl", "upper"): [0.97],
            ("pooled_cpl", "lower"): [0.3],
            ("popl", "upper"): [0.95],
            ("popl", "lower"): [0.9],
            ("oracle", "upper"): [1.0],
            ("random", "upper"): [0.0],
            ("mine", "lower"): [0.5],
        }
    )
    fig = recovery_bars(results)
    (ax,) = fig.axes
    heights = {round(bar.get_x() + bar.get_width() / 2, 3): bar.get_height() for bar in bars(ax)}
    width = 0.8 / 3
    assert heights == pytest.approx(
        {
            round(-width, 3): 0.95,
            0.0: 0.97,
            round(1 - width, 3): 0.9,
            1.0: 0.3,
            round(1 + width, 3): 0.5,
        }
    )
    assert [text.get_text() for text in fig.legends[0].get_texts()] == [
        "POPL (catered)",
        "CPL on everybody's answers",
        "mine",
    ]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["“upper”", "“lower”"]
    assert {float(np.asarray(line.get_ydata())[0]) for line in ax.lines} == {0, 1}
    for words in ("0.95", "0.30", "as good as the oracle", "as good as random actions"):
        assert words in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_recovery_of_several_runs_is_averaged_and_dotted() -> None:
    fig = recovery_bars(tidy({("popl", "upper"): [0.8, 1.0, np.nan]}))
    (ax,) = fig.axes
    assert bars(ax)[0].get_height() == pytest.approx(0.9)
    assert points(dots(ax)[0])[:, 1].tolist() == [0.8, 1.0]


def test_recovery_far_outside_is_cut_off_but_named() -> None:
    fig = recovery_bars(tidy({("popl", "upper"): [-7.0], ("popl", "lower"): [3.0]}))
    (ax,) = fig.axes
    low, high = ax.get_ylim()
    assert all(low < bar.get_height() < high for bar in bars(ax))
    assert "−7.00 ↓" in texts(fig)
    assert "3.00 ↑" in texts(fig)


def test_recovery_needs_numbers() -> None:
    results = tidy({("oracle", "upper"): [1.0], ("popl", "upper"): [float("nan")]})
    with pytest.raises(ValueError, match=r"'recovery' of a method other than .* run the baselines"):
        recovery_bars(results)


def test_shares_of_the_optimum_are_drawn_where_they_are_known() -> None:
    """The oracle is a bar as any other then; only random actions are 0 by definition."""
    shares = {("popl", "upper"): [0.9], ("oracle", "upper"): [0.95], ("random", "upper"): [0.0]}
    both = [tidy(shares, "share_of_optimum"), tidy({("popl", "upper"): [2.0]})]
    fig = recovery_bars(pd.concat(both))
    (ax,) = fig.axes
    assert sorted(bar.get_height() for bar in bars(ax)) == [0.9, 0.95]
    assert ax.get_ylabel() == "share of optimum"
    assert "the optimum" in texts(fig)
    assert "as good as the oracle" not in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_a_method_is_drawn_once_for_each_choice_in_a_colour_of_its_own() -> None:
    """What the run trained is blue, and sky where catered by lexicase, whatever it is called."""
    rows = [(name, "upper", "recovery", 0.5) for name in ("posterior", "lexicase")]
    results = pd.DataFrame([("mine", *row) for row in rows], columns=RESULT_COLUMNS)
    fig = recovery_bars(results)
    colours = [to_hex(bar.get_facecolor()) for bar in bars(fig.axes[0])]
    assert colours == [to_hex(PALETTE["blue"]), to_hex(PALETTE["sky"])]
    assert [text.get_text() for text in fig.legends[0].get_texts()] == [
        "mine (catered)",
        "mine (catered by lexicase)",
    ]


def test_recovery_needs_its_columns() -> None:
    with pytest.raises(ValueError, match=r"'choice', 'group', 'measure', 'value'\], \['choice'\]"):
        recovery_bars(tidy({}).drop(columns="choice"))
