"""What returned sets guarantee, by the size of the population that they come from."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from popl_rl.plotting.style import LEGEND, PALETTE, headline, tidy

__all__ = ["guarantee_curves"]

_COUNTS = {
    "members": ("returned", "black", "-"),
    "undominated_training": ("not dominated, training raters", "blue", "-"),
    "undominated": ("not dominated, fresh raters and questions", "orange", "--"),
    "undominated_beside_oracles": (
        "not dominated by groups' exact wishes and oracles",
        "green",
        "-",
    ),
}
_ACCURACIES = {
    "best_accuracy": ("best of the set", "black", "-"),
    "oracle_accuracy": ("oracle", "grey", ":"),
}


def guarantee_curves(rows: pd.DataFrame, scenarios: dict[str, str]) -> Figure:
    """Undominated members, and how well the best of them serve, over the population's size.

    Args:
        rows: Rows of ``popl_rl.experiments.guarantees.guarantee_rows``.
        scenarios: Scenario -> title, a column of panels for each.

    Raises:
        ValueError: If a scenario has no rows.
    """
    missing = [name for name in scenarios if not (rows["scenario"] == name).any()]
    if missing:
        raise ValueError(f"rows must hold all scenarios, got none of {missing}; run their cells")
    fig = Figure(figsize=(3.4 * len(scenarios) + 2.4, 5.2))
    headline(
        fig,
        "What is not dominated in the population, and beyond it",
        "Members that no other dominates (above), and accuracy of the best member for each group,\n"
        "mean over groups (below). Small dots are seeds, lines their means.",
    )
    axes = fig.subplots(2, len(scenarios), squeeze=False, sharex=True, sharey="row")
    for column, (scenario, title) in enumerate(scenarios.items()):
        own = rows[rows["scenario"] == scenario]
        wide = own.pivot_table(index=["method", "seed"], columns="measure", values="value")
        for ax, measures in zip(axes[:, column], (_COUNTS, _ACCURACIES), strict=True):
            _draw(ax, wide, measures)
        axes[0, column].set_title(title, fontsize=10)
        axes[1, column].set_xlabel("members of the population")
    axes[0, 0].set(ylabel="members", ylim=(0, None))
    axes[1, 0].set(ylabel="accuracy", ylim=(0.5, 1.02))
    for ax in axes[:, -1]:
        ax.legend(loc="upper left", bbox_to_anchor=(1, 1), **LEGEND)
    return fig


def _draw(ax: Axes, wide: pd.DataFrame, measures: dict[str, tuple[str, str, str]]) -> None:
    """A line for each measure over the population's size, and a dot for each seed."""
    sizes = sorted(wide["population"].unique())
    for measure, (label, colour, line) in measures.items():
        mean = wide.groupby("population")[measure].mean()
        ax.plot(
            mean.index, mean, line, color=PALETTE[colour], marker="o", markersize=4, label=label
        )
        ax.scatter(wide["population"], wide[measure], s=6, color=PALETTE[colour], alpha=0.5)
    ax.set_xscale("log", base=2)
    ax.set_xticks(sizes, [f"{size:g}" for size in sizes])
    ax.xaxis.set_minor_locator(NullLocator())
    ax.grid(color="0.92")
    ax.set_axisbelow(True)
    tidy(ax)
