"""What all pictures share: colours, headlines, and how they are written."""

import io
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from popl_rl.storage import write_atomic

__all__ = ["LEGEND", "MEMBER_COLOURS", "PALETTE", "headline", "legend_beside", "save", "tidy"]

PALETTE = {
    "blue": "#0072B2",
    "orange": "#E69F00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "vermilion": "#D55E00",
    "sky": "#56B4E9",
    "black": "#000000",
    "grey": "#767676",
}
"""Colours that stay apart for colour-blind readers (Okabe and Ito, 2008), and a grey."""

_DPI = 120


def save(fig: Figure, path: Path) -> None:
    """Write a figure as a PNG of 120 dots per inch, whole or not at all.

    Its layout is settled by this: later changes are not laid out anew.
    """
    fig.set_dpi(_DPI)
    layout = fig.get_layout_engine()
    if layout is not None:
        # Matplotlib draws everything once more to lay it out while it saves; placed before, it is
        # drawn once.
        layout.execute(fig)
        fig.set_layout_engine("none")
    png = io.BytesIO()
    fig.savefig(png, format="png", dpi=_DPI)
    write_atomic(path, png.getvalue())


def tidy(ax: Axes) -> None:
    """Leave out the frame above and to the right."""
    ax.spines[["top", "right"]].set_visible(False)


def headline(fig: Figure, title: str, subtitle: str) -> None:
    """Write title and subtitle at the upper left, and keep the room below for the axes."""
    inch = 1 / fig.get_figheight()
    fig.text(0.1 / fig.get_figwidth(), 1 - 0.08 * inch, title, va="top", fontsize=13, weight="bold")
    fig.text(
        0.1 / fig.get_figwidth(),
        1 - 0.36 * inch,
        subtitle,
        va="top",
        fontsize=9,
        color=PALETTE["grey"],
    )
    lines = 1 + subtitle.count("\n")
    room = (0.4 + 0.17 * lines) * inch
    fig.set_layout_engine("constrained", rect=(0, 0, 1, 1 - room))


MEMBER_COLOURS = tuple(PALETTE[name] for name in ("blue", "vermilion", "green", "purple", "sky"))


LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 9}


def legend_beside(ax: Axes, text: str, height: float, colour: str) -> None:
    """Write what a line is to the right of the axes, at the height where it ends."""
    ax.annotate(
        text,
        (1, height),
        xycoords=("axes fraction", "data"),
        xytext=(6, 0),
        textcoords="offset points",
        va="center",
        fontsize=9,
        color=colour,
    )
