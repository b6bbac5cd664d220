import inspect
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray

from popl_rl.plotting import run_plots as plots
from popl_rl.plotting import style as plot_style
from popl_rl.plotting.member_plots import members

PNG = b"\x89PNG\r\n"


def texts(fig: Figure) -> str:
    """Everything that can be read in a figure."""
    found = [text.get_text() for text in fig.texts]
    for ax in fig.axes:
        found += [ax.get_title(), ax.get_xlabel(), ax.get_ylabel()]
        found += [text.get_text() for text in ax.texts]
    for legend in fig.legends:
        found += [text.get_text() for text in legend.get_texts()]
    return "\n".join(found).replace("\n", " ")


def ylabelled(fig: Figure, start: str) -> Axes:
    (ax,) = [ax for ax in fig.axes if ax.get_ylabel().replace("\n", " ").startswith(start)]
    return ax


def assert_nothing_overlaps_the_edge(fig: Figure) -> None:
    fig.draw_without_rendering()
    box = fig.get_tightbbox()
    assert box.x0 > -0.02
    assert box.y0 > -0.02
    assert box.x1 < fig.get_figwidth() + 0.02
    assert box.y1 < fig.get_figheight() + 0.02


def test_a_figure_is_saved_as_a_png_of_120_dots_per_inch(tmp_path: Path) -> None:
    from PIL import Image

    fig = Figure(figsize=(2, 1))
    plot_style.save(fig, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(PNG)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (240, 120)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_pyplot_is_not_used() -> None:
    source = inspect.getsource(inspect.getmodule(plots.learning_curves))
    assert "import matplotlib.pyplot" not in source
    assert "rcParams" not in source
    before = dict(mpl.rcParams)
    plots.learning_curves(curves())
    assert dict(mpl.rcParams) == before


# Occupancy


def grids(count: int = 2) -> dict[str, NDArray[np.float64]]:
    maps = {f"policy {i}": np.zeros((2, 3)) for i in range(count)}
    for i, table in enumerate(maps.values()):
        table.flat[i % 6] = 3
        table.flat[(i + 1) % 6] = 1
    return maps


def held_out(fig: Figure) -> list[Axes]:
    return [ax for ax in fig.axes if ax.get_title()]


def test_occupancy_shows_shares_over_the_picture_and_leaves_unvisited_cells_free() -> None:
    picture = np.full((20, 30, 3), 7, dtype=np.uint8)
    fig = plots.occupancy(picture, grids(), suptitle="Where to?", caption="Look at the doors.")
    assert [ax.get_title() for ax in held_out(fig)] == ["policy 0", "policy 1"]
    for index, ax in enumerate(held_out(fig)):
        below, heat = ax.images
        assert np.array_equal(np.asarray(below.get_array()), picture)
        assert tuple(below.get_extent()) == tuple(heat.get_extent()) == (0, 3, 2, 0)
        share, alpha = np.asarray(heat.get_array()), np.asarray(heat.get_alpha())
        cell = share.shape[0] // 2
        centre = slice(cell // 2, None, cell)
        assert share[centre, centre].flat[index] == 0.75, "three of four steps"
        assert share[centre, centre].sum() == 1
        visited = alpha[centre, centre] > 0
        assert visited.sum() == 2
        assert visited.flat[index]
        assert heat.norm.vmax == 0.75
        assert heat.norm.vmin == 0
    assert "Where to? Look at the doors." in texts(fig)
    assert "share of steps" in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


@pytest.mark.parametrize(("count", "shape"), [(1, (1, 1)), (4, (1, 4)), (5, (2, 3)), (9, (3, 3))])
def test_occupancy_lays_out_any_number_of_policies(count: int, shape: tuple[int, int]) -> None:
    fig = plots.occupancy(None, grids(count), suptitle="a", caption="b")
    assert len(held_out(fig)) == count
    grid = held_out(fig)[0].get_gridspec()
    assert grid is not None
    assert (grid.nrows, grid.ncols) == shape
    fig.draw_without_rendering()


def test_occupancy_of_a_policy_that_goes_nowhere_is_empty() -> None:
    fig = plots.occupancy(None, {"a": np.zeros((2, 2))}, suptitle="a", caption="b")
    assert not np.asarray(held_out(fig)[0].images[1].get_alpha()).any()
    fig.draw_without_rendering()


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({}, "maps must hold at least one"),
        ({"a": np.zeros((2, 2)), "b": np.zeros((2, 3))}, r"one shape, got \[\(2, 2\), \(2, 3\)\]"),
        ({"a": np.zeros(2)}, r"maps\['a'\] must be a table"),
        ({"a": np.full((2, 2), np.nan)}, r"maps\['a'\] must be a table .* finite"),
        ({"a": np.full((2, 2), -1)}, r"maps\['a'\] must be a table .* non-negative"),
    ],
)
def test_occupancy_checks_its_maps(maps: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plots.occupancy(None, maps, suptitle="a", caption="b")


# Members

GROUPS = ["upper", "lower", "third", "fourth", "fifth"]


def spread(groups: int, generations: int = 3, members: int = 4) -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform(0.4, 0.9, (generations, members, groups))


def dots(ax: Axes) -> list[PathCollection]:
    return [drawn for drawn in ax.collections if isinstance(drawn, PathCollection)]


def points(drawn: PathCollection) -> NDArray[np.float64]:
    return np.asarray(drawn.get_offsets())


def brightness(drawn: PathCollection) -> float:
    return float(np.asarray(drawn.get_facecolor())[0, :3].mean())


def test_members_are_dots_from_pale_to_dark_with_what_was_chosen_marked() -> None:
    accuracy = spread(2)
    fig = members(
        accuracy,
        [0, 5, 10],
        GROUPS[:2],
        catered={"upper": 1, "lower": 3},
        pooled=[0.6, 0.7],
        oracle={"upper": np.array([0.95, 0.5])},
    )
    ax = ylabelled(fig, "agrees with “lower”")
    assert ax.get_xlabel() == "agrees with “upper”"
    first, second, last, *marked = dots(ax)
    for drawn, generation in zip((first, second, last), accuracy, strict=True):
        assert np.array_equal(points(drawn), generation)
    assert brightness(first) > brightness(second) > brightness(last)
    marks = {str(mark.get_label()): points(mark)[0] for mark in marked}
    assert marks.keys() == {
        "POPL for “upper”",
        "oracle of “upper”",
        "POPL for “lower”",
        "one policy for everybody",
    }
    assert np.array_equal(marks["POPL for “upper”"], accuracy[-1, 1])
    assert np.array_equal(marks["POPL for “lower”"], accuracy[-1, 3])
    assert np.array_equal(marks["oracle of “upper”"], [0.95, 0.5])
    assert np.array_equal(marks["one policy for everybody"], [0.6, 0.7])
    assert set(marks) == {text.get_text() for text in fig.legends[0].get_texts()}
    low, high = ax.get_xlim()
    assert ax.get_ylim() == (low, high)
    assert all(((low < points(d)) & (points(d) < high)).all() for d in dots(ax))
    assert "only “lower”" in texts(fig)
    assert "generation of a member" in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_members_of_several_groups_are_shown_pair_by_pair(count: int) -> None:
    names = GROUPS[:count]
    oracle = {name: np.full(count, 0.8) for name in names}
    fig = members(
        spread(count),
        [0, 1, 2],
        names,
        catered=dict.fromkeys(names, 0),
        pooled=np.full(count, 0.6),
        oracle=oracle,
    )
    drawn = [ax for ax in fig.axes if ax.get_xlabel()]
    pairs = list(combinations(names, 2))[:6]
    assert [(ax.get_xlabel(), ax.get_ylabel()) for ax in drawn] == [
        (f"agrees with “{x}”", f"agrees with “{y}”") for x, y in pairs
    ]
    for ax, (x, y) in zip(drawn, pairs, strict=True):
        labels = {c.get_label() for c in ax.collections if not str(c.get_label()).startswith("_")}
        assert labels == {
            *(f"POPL for “{name}”" for name in (x, y)),
            *(f"oracle of “{name}”" for name in (x, y)),
            "one policy for everybody",
        }
    assert_nothing_overlaps_the_edge(fig)


def test_members_of_one_generation_without_baselines() -> None:
    fig = members(spread(2, 1), [60], ["a", "b"], catered={})
    assert len(fig.axes) == 1, "no colour bar for one generation"
    assert not fig.legends
    assert brightness(dots(fig.axes[0])[0]) < 0.5


def test_members_checks_what_it_is_given() -> None:
    with pytest.raises(ValueError, match=r"2 generations and 2 groups .* got shape \(3, 4, 2\)"):
        members(spread(2), [0, 1], ["a", "b"], catered={})
    with pytest.raises(ValueError, match=r"1 groups \(at least 2\), got shape \(3, 4, 1\)"):
        members(spread(1), [0, 1, 2], ["a"], catered={})
    with pytest.raises(ValueError, match=r"groups of \['a', 'b'\], got \['c'\]"):
        members(spread(2), [0, 1, 2], ["a", "b"], catered={"c": 0})


# Curves


def curves(rows: int = 5) -> pd.DataFrame:
    generation = np.arange(1, rows + 1)
    return pd.DataFrame(
        {
            "generation": generation,
            "worst_rater_accuracy": 0.5 + 0.05 * generation,
            "mean_accuracy": 0.5 + 0.01 * generation,
            "loss_cpl": 1 / generation,
            "selection_depth": 10.0 + generation,
            "distinct": 30.0,
            "effective_parents": 12.0,
        }
    )


def lines(ax: Axes) -> list[NDArray[np.float64]]:
    """The curves of a panel, without lines across it."""
    found = [np.asarray(line.get_ydata(), dtype=float) for line in ax.lines]
    assert all(np.isfinite(values).all() for values in found)
    return [values for values in found if len(values) != 2]


def test_learning_curves_are_drawn_and_named_beside_their_ends() -> None:
    metrics = curves()
    fig = plots.learning_curves(metrics)
    worst, mean = lines(ylabelled(fig, "training answers ranked right"))
    assert np.array_equal(worst, metrics["worst_rater_accuracy"])
    assert np.array_equal(mean, metrics["mean_accuracy"])
    (loss,) = lines(ylabelled(fig, "loss of"))
    assert np.array_equal(loss, metrics["loss_cpl"])
    for words in ("worst-served tenth", "average member", "guessing", "CPL loss", "generation"):
        assert words in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


@pytest.mark.parametrize(
    "metrics", [curves().drop(columns="loss_cpl"), curves().assign(loss_cpl=None)]
)
def test_learning_curves_do_without_a_loss(metrics: pd.DataFrame) -> None:
    fig = plots.learning_curves(metrics)
    assert len(fig.axes) == 1
    assert fig.axes[0].get_xlabel() == "generation"


@pytest.mark.parametrize("rows", [0, 1])
def test_curves_of_a_run_that_has_hardly_begun(rows: int) -> None:
    for draw in (plots.learning_curves, plots.selection):
        draw(curves(rows)).draw_without_rendering()


def test_selection_shows_depth_and_diversity() -> None:
    metrics = curves()
    fig = plots.selection(metrics)
    distinct, effective = lines(ylabelled(fig, "members"))
    assert np.array_equal(distinct, metrics["distinct"])
    assert np.array_equal(effective, metrics["effective_parents"])
    (depth,) = lines(ylabelled(fig, "cases until one member is left"))
    assert np.array_equal(depth, metrics["selection_depth"])
    for words in ("effective parents", "members that rank the answers differently", "cases used"):
        assert words in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_a_missing_column_is_named() -> None:
    for draw in (plots.learning_curves, plots.selection):
        with pytest.raises(ValueError, match=r"have the columns .*\['generation'\] are missing"):
            draw(curves().drop(columns="generation"))


def test_colours_are_all_different() -> None:
    assert len({to_rgba(colour) for colour in plot_style.PALETTE.values()}) == len(
        plot_style.PALETTE
    )
