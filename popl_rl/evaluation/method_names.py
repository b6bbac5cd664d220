"""The methods of a results table: what people read, in which colour, and in which order.

The one list of the methods that the library reports on. How a member was chosen from a set is told
by the column ``choice`` of a table, never by the name of its method.
"""

from dataclasses import dataclass

__all__ = [
    "CHOICES",
    "METHODS",
    "ReportedMethod",
    "drawn_references",
    "method_colour",
    "method_name",
    "sort_key",
]


@dataclass(frozen=True)
class ReportedMethod:
    """How a method appears in tables and figures.

    Attributes:
        label: Name to print.
        colour: Colour in figures, a key of ``popl_rl.plotting.style.PALETTE``; empty for whatever
            colour is free.
        is_reference: Whether it is evaluated beside the method that a run trains, so that no other
            method may have its name. The references with a colour are drawn in every figure.
        is_shown: Whether tables and figures show it; its rows are in ``results.csv`` in any case.
    """

    label: str
    colour: str = ""
    is_reference: bool = False
    is_shown: bool = True


METHODS = {
    "popl": ReportedMethod("POPL", "blue"),
    "multi_cpl": ReportedMethod("several CPL policies on everybody's answers", "blue"),
    "em": ReportedMethod("EM mixture of CPL policies", "blue"),
    "vpl": ReportedMethod("VPL, latent variable", "blue"),
    "lore": ReportedMethod("LoRe, low-rank reward functions", "blue"),
    "kmeans": ReportedMethod("k-means of raters, then CPL", "blue"),
    "pooled_cpl": ReportedMethod("CPL on everybody's answers", "orange", True),
    "bradley_terry": ReportedMethod("Bradley–Terry on everybody's answers", "orange", True),
    "brex": ReportedMethod("B-REX", "", True),
    "dpl_mean_variance": ReportedMethod("DPL, mean and variance", "", True),
    "dpl_categorical": ReportedMethod("DPL, categorical", "", True),
    "individual": ReportedMethod("one model for each person", "", True),
    "oracle": ReportedMethod("oracle (told the groups)", "black", True),
    "optimum": ReportedMethod("optimum", "", True, is_shown=False),
    "ppo": ReportedMethod("PPO on the group's utility", "", True),
    "best_behaviour": ReportedMethod("best behaviour in the data", "", True),
    "data": ReportedMethod("behaviours of the data", "", True),
    "behaviour": ReportedMethod("behaviour", "", True, is_shown=False),
    "clone": ReportedMethod("clone of the data", "", True),
    "random": ReportedMethod("random actions", "", True),
}
"""Methods by their names in ``results.csv``, in the order to show them in."""

CHOICES = {
    "": "",
    "posterior": " (catered)",
    "information_gain": " (catered, questions chosen)",
    "lexicase": " (catered by lexicase)",
    "mixture": " (mixture)",
    "single": " (best single)",
    "encoder": " (told by its encoder)",
    "fitted": " (weights fitted)",
    "expectation": "",
    "risk_averse": ", risk-averse",
}
"""What a choice adds to the name of a method, in the order to show them in."""


def method_name(method: str, choice: str = "") -> str:
    """Name to print for a method of a results table.

    Args:
        method: Value of the column ``method``; printed as it is if unknown.
        choice: Value of the column ``choice``.
    """
    label = METHODS[method].label if method in METHODS else method
    return label + CHOICES.get(choice, f" ({choice})")


def method_colour(method: str, choice: str = "") -> str:
    """Key of the palette for a method in the figures of one run; empty for any that is free.

    Args:
        method: Value of the column ``method``. One that is not listed is drawn as the method that
            the run trained if there is a choice from its set.
        choice: Value of the column ``choice``.
    """
    own = "blue" if choice in ("posterior", "lexicase") else ""
    colour = METHODS[method].colour if method in METHODS else own
    return "sky" if (colour, choice) == ("blue", "lexicase") else colour


def drawn_references() -> list[str]:
    """Names of the references that every figure shows beside the methods that it compares."""
    return [name for name, method in METHODS.items() if method.is_reference and method.colour]


def sort_key(method: str, choice: str) -> tuple[int, int]:
    """Place of a method and choice in a table: those that are not listed come last."""
    methods, choices = list(METHODS), list(CHOICES)
    return (
        methods.index(method) if method in METHODS else len(methods),
        choices.index(choice) if choice in CHOICES else len(choices),
    )
