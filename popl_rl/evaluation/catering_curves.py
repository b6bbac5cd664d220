"""What new raters are given after other numbers of answers: measures such as ``recovery@5``."""

from collections.abc import Mapping

from torch import Tensor

from popl_rl.evaluation.measures import group_returns
from popl_rl.evaluation.results import Rows, Served

__all__ = ["score_curves"]


def score_curves(
    rows: Rows,
    label: str,
    served: Served,
    points: Mapping[tuple[str, int], Tensor],
    accuracy: Tensor,
) -> None:
    """Add ``accuracy@K`` and, where all members of a point were rolled out, the recoveries.

    Args:
        rows: What is added to.
        label: Name of the method.
        served: Members that were rolled out.
        points: Member of each new rater, ``[G, raters]``, by choice and number of answers.
        accuracy: Of each hypothesis on each group's held-out pairs, ``[P, G]``.
    """
    done = served.performance
    returns = group_returns(done.episodes, rows.groups)
    for index in range(len(rows.groups)):
        for (choice, answers), chosen in points.items():
            entry = label, choice
            value = float(accuracy[chosen[index], index].mean())
            rows.add_value(entry, index, f"accuracy@{answers}", value)
            if not set(chosen.flatten().tolist()) <= set(served.members):
                continue
            share = served.share(index, chosen)
            value = rows.recovery(index, float(returns[:, index] @ share))
            rows.add_value(entry, index, f"recovery@{answers}", value)
            if done.exact is not None:
                value = float(done.exact[:, index] @ share.double())
                rows.add_share(entry, index, value, suffix=f"@{answers}")
