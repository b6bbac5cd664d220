"""How well new people's answers are predicted, over the number of answers that are known."""

import pandas as pd
from matplotlib.figure import Figure

from popl_rl.evaluation.method_names import method_name
from popl_rl.plotting.style import LEGEND, PALETTE, headline, tidy

__all__ = ["people_curves"]

_COLOURS = {
    "popl": "blue",
    "em": "vermilion",
    "vpl": "green",
    "lore": "sky",
    "pooled_cpl": "orange",
    "individual": "purple",
}
_LINES = {"posterior": "-", "mixture": "--", "single": ":", "": "-", "encoder": "-", "fitted": "-"}


def people_curves(results: pd.DataFrame, *, group: str = "all") -> Figure:
    """Accuracy and log-likelihood of people's further answers, with 95 % intervals over people.

    Args:
        results: Rows as of `popl_rl.evaluation.people_statistics.summarise_people`.
        group: Which people.

    Raises:
        ValueError: If there are no such rows.
    """
    rows = results[results["group"] == group]
    parts = rows["measure"].str.extract(r"^(accuracy|log_likelihood)(_low|_high)?@(\d+)$")
    rows = rows.assign(what=parts[0], end=parts[1].fillna(""), answers=parts[2])
    rows = rows[rows["what"].notna()]
    if rows.empty:
        raise ValueError(f"results must hold accuracies of the group {group!r}, got none")
    rows = rows.assign(answers=rows["answers"].astype(int))
    fig = Figure(figsize=(9, 4.2))
    headline(
        fig,
        "How well are new people's further answers predicted?",
        "Over people who were held out. Bands: 95 % intervals, bootstrap over people.",
    )
    points = sorted(rows["answers"].unique())
    axes = fig.subplots(1, 2)
    for ax, (what, name) in zip(
        axes, {"accuracy": "accuracy", "log_likelihood": "log-likelihood"}.items(), strict=True
    ):
        own = rows[rows["what"] == what]
        for (method, choice), line in own.groupby(["method", "choice"], sort=False):
            by_end = {end: part.set_index("answers")["value"] for end, part in line.groupby("end")}
            mean = by_end[""].reindex(points)
            colour = PALETTE[_COLOURS.get(str(method), "grey")]
            style = _LINES.get(str(choice), "-.")
            place = range(len(points))
            ax.plot(place, mean, style, color=colour, label=method_name(str(method), str(choice)))
            if choice in ("posterior", "", "encoder") and "_low" in by_end:
                low, high = (by_end[end].reindex(points) for end in ("_low", "_high"))
                ax.fill_between(place, low, high, color=colour, alpha=0.12, linewidth=0)
        ax.set_xticks(range(len(points)), [str(point) for point in points])
        ax.set_xlabel("answers of the person that are known")
        ax.set_ylabel(name)
        tidy(ax)
    axes[1].legend(**LEGEND, loc="upper left", bbox_to_anchor=(1.02, 1))
    return fig
