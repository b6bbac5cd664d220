import inspect
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection, LineCollection, QuadMesh
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch

from popl_rl.evaluation.ranking_agreement import rank_shares
from popl_rl.plotting import style as plot_style
from popl_rl.plotting.agreement_plots import agreement
from popl_rl.plotting.majority_plots import majority_figure
from popl_rl.plotting.utility_plots import Curves, utilities
from popl_rl.raters.condorcet import majority_preference

STATES = np.linspace(0, 1, 21)
TRUTHS = {
    "zeroed": np.where(STATES < 0.8, STATES, 0),
    "doubled": np.where(STATES < 0.8, STATES, 2 * STATES),
}
CYCLE = {f"third {k}": (STATES + 0.001 + k / 3) % 1 for k in range(3)}
MEMBERS = np.random.default_rng(0).normal(size=(7, 21)).cumsum(1)


def texts(fig: Figure) -> str:
    """Everything that can be read in a figure."""
    found = [text.get_text() for text in fig.texts]
    for ax in fig.axes:
        found += [ax.get_title(), ax.get_xlabel(), ax.get_ylabel()]
        found += [text.get_text() for text in ax.texts]
        found += [label.get_text() for label in [*ax.get_xticklabels(), *ax.get_yticklabels()]]
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


def held_out(fig: Figure, title: str) -> Axes:
    (ax,) = [ax for ax in fig.axes if ax.get_title() == title]
    return ax


def heat(ax: Axes) -> Any:
    (mesh,) = [drawn for drawn in ax.collections if isinstance(drawn, QuadMesh)]
    return np.ma.filled(np.ma.asarray(mesh.get_array()).astype(float), np.nan)


def stretched(curve: Any) -> Any:
    return (curve - np.min(curve)) / (np.max(curve) - np.min(curve))


def three_methods() -> dict[str, Curves]:
    line = MEMBERS.mean(0)
    return {
        "POPL": Curves(members=MEMBERS, best={"zeroed": MEMBERS[2], "doubled": MEMBERS[4]}),
        "B-REX": Curves(members=MEMBERS[:3], line=line),
        "DPL": Curves(line=line, band=(line - 2, line + 3)),
    }


def curves_of(ax: Axes, colour: str, dashed: bool) -> list[Any]:
    return [
        line.get_ydata()
        for line in ax.lines
        if line.get_color() == colour and line.is_dashed() == dashed
    ]


# Utilities


def test_every_method_is_drawn_beside_the_truth() -> None:
    fig = utilities(STATES, TRUTHS, three_methods())
    blue, vermilion = plot_style.PALETTE["blue"], plot_style.PALETTE["vermilion"]
    for title in ("POPL", "B-REX", "DPL"):
        for name, colour in (("zeroed", blue), ("doubled", vermilion)):
            (truth,) = curves_of(held_out(fig, title), colour, dashed=True)
            np.testing.assert_allclose(truth, stretched(TRUTHS[name]))
    popl, brex, dpl = (held_out(fig, title) for title in ("POPL", "B-REX", "DPL"))
    for ax, expected in ((popl, MEMBERS), (brex, MEMBERS[:3])):
        (drawn,) = [found for found in ax.collections if isinstance(found, LineCollection)]
        for path, member in zip(drawn.get_paths(), expected, strict=True):
            np.testing.assert_allclose(path.vertices, np.stack([STATES, stretched(member)], 1))
    np.testing.assert_allclose(curves_of(popl, blue, dashed=False), [stretched(MEMBERS[2])])
    np.testing.assert_allclose(curves_of(popl, vermilion, dashed=False), [stretched(MEMBERS[4])])
    assert curves_of(popl, "black", dashed=False) == []
    np.testing.assert_allclose(curves_of(brex, "black", dashed=False), [stretched(MEMBERS.mean(0))])
    assert not dpl.get_legend()
    for words in (
        "Only the shape of a utility matters",
        "what “zeroed” really wants",
        "what “doubled” is given",
        "one hypothesis of many",
        "one utility for everybody",
        "± one standard deviation",
    ):
        assert words in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_a_band_is_stretched_together_with_its_line() -> None:
    low, line, high = np.zeros(21), np.linspace(1, 2, 21), np.full(21, 4.0)
    fig = utilities(STATES, TRUTHS, {"DPL": Curves(line=line, band=(low, high))})
    ax = held_out(fig, "DPL")
    np.testing.assert_allclose(curves_of(ax, "black", dashed=False), [line / 4])
    (band,) = [c for c in ax.collections if isinstance(c, FillBetweenPolyCollection)]
    corners = band.get_paths()[0].vertices
    assert corners[:, 1].min() == 0
    assert corners[:, 1].max() == 1


def test_states_may_come_in_any_order_and_as_tensors() -> None:
    order = np.random.default_rng(1).permutation(21)
    truths = {name: torch.from_numpy(truth[order]) for name, truth in TRUTHS.items()}
    shuffled = {"POPL": Curves(members=torch.from_numpy(MEMBERS[:, order]), line=MEMBERS[0][order])}
    ax = held_out(utilities(torch.from_numpy(STATES[order]), truths, shuffled), "POPL")
    np.testing.assert_allclose(curves_of(ax, "black", dashed=False), [stretched(MEMBERS[0])])
    np.testing.assert_allclose(
        curves_of(ax, plot_style.PALETTE["blue"], dashed=True), [stretched(TRUTHS["zeroed"])]
    )
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), STATES)


def test_a_flat_utility_lies_in_the_middle() -> None:
    ax = held_out(utilities(STATES, TRUTHS, {"flat": Curves(line=np.full(21, 7.0))}), "flat")
    np.testing.assert_array_equal(curves_of(ax, "black", dashed=False), [np.full(21, 0.5)])


def test_not_more_members_are_drawn_than_there_is_room_for() -> None:
    many = np.random.default_rng(0).normal(size=(1000, 21))
    ax = held_out(utilities(STATES, TRUTHS, {"B-REX": Curves(members=many)}), "B-REX")
    (drawn,) = [found for found in ax.collections if isinstance(found, LineCollection)]
    assert len(drawn.get_paths()) == 200
    np.testing.assert_allclose(drawn.get_paths()[-1].vertices[:, 1], stretched(many[-1]))


@pytest.mark.parametrize(("count", "shape"), [(1, (1, 1)), (2, (1, 2)), (4, (2, 2)), (5, (2, 3))])
def test_any_number_of_methods_is_laid_out(count: int, shape: tuple[int, int]) -> None:
    fig = utilities(STATES, TRUTHS, {f"m{i}": Curves(line=MEMBERS[i]) for i in range(count)})
    grid = held_out(fig, "m0").get_gridspec()
    assert grid is not None
    assert (grid.nrows, grid.ncols) == shape
    assert_nothing_overlaps_the_edge(fig)


@pytest.mark.parametrize("groups", [1, 6])
def test_any_number_of_groups_is_laid_out(groups: int) -> None:
    truths = {f"a group of raters {i}": MEMBERS[i] for i in range(groups)}
    assert_nothing_overlaps_the_edge(
        utilities(STATES, truths, {"a": Curves(members=MEMBERS, best=truths)})
    )
    fig = agreement(STATES, truths, MEMBERS, catered=dict.fromkeys(truths, 1))
    assert_nothing_overlaps_the_edge(fig)


BAD_CURVES = [
    (Curves(), r"panels\['a'\] must hold members, best or line"),
    (Curves(members=np.ones(21)), r"panels\['a'\].members must have shape \[curves, 21 states\]"),
    (Curves(members=np.ones((0, 21))), r"members must have shape .* got \(0, 21\)"),
    (Curves(line=np.ones(20)), r"panels\['a'\].line must have shape \[21 states\], got \(20,\)"),
    (Curves(line=np.full(21, np.nan)), r"panels\['a'\].line must be finite"),
    (Curves(best={"nobody": np.ones(21)}), r"name groups of \['zeroed', 'doubled'\], got 'nob"),
    (Curves(best={"zeroed": np.ones(2)}), r"panels\['a'\].best\['zeroed'\] must have shape"),
    (Curves(members=MEMBERS, band=(STATES, STATES)), "band goes around a line, but there is no"),
    (Curves(line=STATES, band=(STATES, STATES[1:])), r"panels\['a'\].band must have shape"),
]


@pytest.mark.parametrize(("curves", "message"), BAD_CURVES)
def test_curves_are_checked(curves: Curves, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        utilities(STATES, TRUTHS, {"a": curves})


def test_states_and_truths_are_checked() -> None:
    for draw in (
        lambda states, truths: utilities(states, truths, {"a": Curves(line=states)}),
        lambda states, truths: agreement(states, truths, MEMBERS),
        lambda states, truths: majority_figure(states, truths, np.full((21, 21), 0.5)),
    ):
        with pytest.raises(ValueError, match="truths must hold at least one group's utility"):
            draw(STATES, {})
        with pytest.raises(ValueError, match=r"truths\['x'\] must have shape \[21 states\]"):
            draw(STATES, {"x": [1.0]})
        with pytest.raises(ValueError, match=r"states must be at least 2 finite positions"):
            draw(STATES[:1], {"x": STATES[:1]})
    with pytest.raises(ValueError, match="panels must hold at least one method"):
        utilities(STATES, TRUTHS, {})


# Agreement


def test_agreement_of_the_population_and_of_who_was_chosen() -> None:
    catered = {"zeroed": [2, 2, 5], "doubled": 4}
    fig = agreement(STATES, TRUTHS, MEMBERS, catered=catered)
    shown = [heat(ax) for ax in fig.axes if ax.get_title().startswith("with")]
    expected = [
        rank_shares(MEMBERS, TRUTHS["zeroed"]),
        rank_shares(MEMBERS, TRUTHS["doubled"]),
        rank_shares(MEMBERS[[2, 2, 5]], TRUTHS["zeroed"]),
        rank_shares(MEMBERS[[4]], TRUTHS["doubled"]),
    ]
    for found, share in zip(shown, expected, strict=True):
        np.testing.assert_allclose(found, share)
    titles = [ax.get_title() for ax in fig.axes if ax.get_title()]
    shares = [f"\n{100 * np.nanmean(share):.0f}%" for share in expected]
    names = ["zeroed", "doubled"] * 2
    assert titles == [f"with “{n}”{share}" for n, share in zip(names, shares, strict=True)]
    for words in ("the whole population", "who was chosen for the group", "Ties are no agreement"):
        assert words in texts(fig)
    assert "pass" not in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_the_true_utility_agrees_wholly_and_a_constant_not_at_all() -> None:
    members = np.stack([TRUTHS["zeroed"], np.zeros(21)])
    fig = agreement(STATES, TRUTHS, members, catered={"zeroed": 0, "doubled": 1})
    assert [ax.get_title() for ax in fig.axes][2:4] == ["with “zeroed”\n100%", "with “doubled”\n0%"]


def test_members_are_ordered_by_likeness_with_the_groups_before_them() -> None:
    kinds = np.random.default_rng(0).permutation(np.arange(20) % 2)
    noise = 0.01 * np.random.default_rng(1).normal(size=(20, 21))
    members = np.stack([TRUTHS[("zeroed", "doubled")[kind]] for kind in kinds]) + noise
    fig = agreement(STATES, TRUTHS, members)
    (whole,) = [ax for ax in fig.axes if "20 members,\nlike beside like" in texts_of(ax)]
    shown = heat(whole)
    assert shown.shape == (2 + 1 + 20, 2 + 1 + 20)
    assert np.isnan(shown[2]).all(), "a gap sets the groups apart"
    assert shown[0, 0] == shown[1, 1] == 1
    np.testing.assert_array_equal(shown, shown.T)
    like_first = shown[0, 3:] > shown[1, 3:]
    assert like_first.tolist() == [True] * 10 + [False] * 10
    assert "“zeroed”" in texts_of(whole)


def texts_of(ax: Axes) -> list[str]:
    return [label.get_text() for label in [*ax.get_xticklabels(), *ax.get_yticklabels()]]


def test_agreement_does_without_choices_or_with_some() -> None:
    assert "chosen" not in texts(agreement(STATES, TRUTHS, MEMBERS))
    fig = agreement(STATES, TRUTHS, MEMBERS, catered={"doubled": 3})
    assert len([ax for ax in fig.axes if ax.get_title()]) == 3
    assert_nothing_overlaps_the_edge(fig)


@pytest.mark.parametrize("count", [1, 2])
def test_agreement_of_few_members(count: int) -> None:
    assert_nothing_overlaps_the_edge(agreement(STATES, TRUTHS, MEMBERS[:count]))


def test_agreement_with_a_group_that_does_not_care() -> None:
    fig = agreement(STATES, {"indifferent": np.ones(21)}, MEMBERS)
    assert fig.axes[0].get_title() == "with “indifferent”\nnothing to rank"
    fig.draw_without_rendering()


def test_agreement_of_very_many() -> None:
    states = np.linspace(0, 1, 500)
    members = np.random.default_rng(0).normal(size=(300, 500))
    fig = agreement(states, {"up": states}, members)
    assert heat(fig.axes[0]).shape == (200, 200)
    assert heat(fig.axes[1]).shape == (202, 202)
    fig.draw_without_rendering()


@pytest.mark.parametrize(
    ("catered", "message"),
    [
        ({"nobody": 1}, r"catered must name groups of \['zeroed', 'doubled'\], got 'nobody'"),
        ({"zeroed": 7}, r"catered\['zeroed'\] must be one or more of the members 0 to 6, got 7"),
        ({"zeroed": [-1]}, "members 0 to 6"),
        ({"zeroed": []}, "one or more of the members"),
        ({"zeroed": 0.5}, "members 0 to 6, got 0.5"),
    ],
)
def test_choices_are_checked(catered: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        agreement(STATES, TRUTHS, MEMBERS, catered=catered)


# Majority


def preferences(truths: dict[str, Any]) -> Any:
    return majority_preference(torch.from_numpy(np.stack([*truths.values()])))


def test_the_circle_of_the_majority_is_shown() -> None:
    preferred = preferences(CYCLE)
    fig = majority_figure(STATES, CYCLE, preferred, cycle=[2, 17, 9])
    middle = held_out(fig, "what the majority says of any two")
    np.testing.assert_allclose(heat(middle), preferred.numpy())
    # Row: the state that is preferred. A beats B, B beats C and C beats A.
    rings = [(line.get_xdata()[0], line.get_ydata()[0]) for line in middle.lines]
    assert rings == [tuple(STATES[[17, 2]]), tuple(STATES[[9, 17]]), tuple(STATES[[2, 9]])]
    circle = held_out(fig, "the majority goes round in a circle")
    assert len([drawn for drawn in circle.patches if isinstance(drawn, Circle)]) == 3
    assert len([drawn for drawn in circle.patches if isinstance(drawn, FancyArrowPatch)]) == 3
    for words in ("67% prefer A to B", "67% prefer B to C", "67% prefer C to A"):
        assert words in texts(fig)
    for words in ("A 0.10", "B 0.85", "C 0.45", "what “third 1” wants"):
        assert words in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_arrows_go_from_the_winner_to_the_loser() -> None:
    fig = majority_figure(STATES, CYCLE, preferences(CYCLE))
    circle = held_out(fig, "the majority goes round in a circle")
    centres = [drawn.center for drawn in circle.patches if isinstance(drawn, Circle)]
    arrows = [drawn for drawn in circle.patches if isinstance(drawn, FancyArrowPatch)]
    for index, arrow in enumerate(arrows):
        start, end = arrow._posA_posB  # type: ignore[attr-defined]
        assert start == pytest.approx(centres[index])
        assert end == pytest.approx(centres[(index + 1) % 3])


def test_a_circle_is_found_and_its_absence_said() -> None:
    assert "67% prefer C to A" in texts(majority_figure(STATES, CYCLE, preferences(CYCLE)))
    fig = majority_figure(STATES, TRUTHS, preferences(TRUTHS))
    assert "No three states are preferred in a circle." in texts(fig)
    assert_nothing_overlaps_the_edge(fig)


def test_states_of_the_majority_may_come_in_any_order() -> None:
    order = np.random.default_rng(0).permutation(21)
    shuffled = {name: truth[order] for name, truth in CYCLE.items()}
    fig = majority_figure(STATES[order], shuffled, preferences(shuffled))
    shown = heat(held_out(fig, "what the majority says of any two"))
    np.testing.assert_allclose(shown, preferences(CYCLE).numpy())


@pytest.mark.parametrize(
    ("preferred", "cycle", "message"),
    [
        (np.ones((20, 21)), None, r"preferred must have shape \[21, 21\], got \[20, 21\]"),
        (np.ones((21, 20)), None, "preferred must have shape"),
        (np.full((21, 21), np.nan), None, "preferred must be finite"),
        (np.ones((21, 21)), [1, 2], r"cycle must be three of the states 0 to 20, got \[1, 2\]"),
        (np.ones((21, 21)), [1, 2, 21], "three of the states 0 to 20"),
        (np.ones((21, 21)), [1, 2, 2], "three of the states"),
    ],
)
def test_the_majority_is_checked(preferred: Any, cycle: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        majority_figure(STATES, CYCLE, preferred, cycle=cycle)


def test_pyplot_is_not_used_and_figures_are_saved(tmp_path: Path) -> None:
    source = "".join(
        inspect.getsource(inspect.getmodule(draw))
        for draw in (utilities, agreement, majority_figure)
    )
    assert "import matplotlib.pyplot" not in source
    assert "rcParams" not in source
    before = dict(mpl.rcParams)
    plot_style.save(majority_figure(STATES, CYCLE, preferences(CYCLE)), tmp_path / "a.png")
    assert dict(mpl.rcParams) == before
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_groups_have_one_colour_in_all_figures() -> None:
    blue = to_rgba(plot_style.PALETTE["blue"])
    first = utilities(STATES, TRUTHS, {"a": Curves(line=STATES)}).axes[0].lines[0].get_color()
    second = agreement(STATES, TRUTHS, MEMBERS).axes[0].title.get_color()
    third = majority_figure(STATES, TRUTHS, preferences(TRUTHS)).axes[0].lines[0].get_color()
    assert to_rgba(first) == to_rgba(second) == to_rgba(third) == blue
