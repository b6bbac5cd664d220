"""Selection with a tolerance of each pool's own, against enumeration."""

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from torch import Tensor

from popl_rl.selection.lexicase import lexicase_report, lexicase_selection

REALS = torch.tensor(
    [
        [0.9, -1.0, 0.3, 5.0],
        [0.8, -0.2, 0.1, 4.5],
        [0.1, -0.1, 0.4, 4.8],
        [0.7, -0.6, 0.9, 1.0],
        [0.2, -3.0, 0.8, 4.9],
    ]
)
# Member 5 shares the row of member 0, and so moves the medians.
CROWD = torch.cat([REALS, REALS[:1]])
GRADES = torch.tensor([[3, 0, 1, 2], [1, 3, 1, 2], [3, 2, 0, 2], [2, 2, 2, 2], [2, 2, 2, 2]])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def assert_fits(counts: Sequence[float], chances: Sequence[float]) -> None:
    """Chi-square test of counts; what has no chance must not occur at all."""
    observed, expected = np.asarray(counts, float), np.asarray(chances) * sum(counts)
    possible = expected > 0
    assert observed[~possible].sum() == 0
    if possible.sum() > 1:
        assert chisquare(observed[possible], expected[possible]).pvalue > 1e-4


def enumerate_dynamic(
    scores: Tensor, limit: int | None = None
) -> tuple[list[float], dict[int, float]]:
    """Chance of each parent, and of each depth, over all orders of the cases."""
    rows = scores.double().numpy()
    parents, depths = [0.0] * len(rows), Counter[int]()
    orders = list(itertools.permutations(range(scores.shape[1])))
    for order in orders:
        pool, depth = np.arange(len(rows)), 0
        for place, case in enumerate(order[:limit], start=1):
            values = rows[pool, case]
            tolerance = np.median(np.abs(values - np.median(values)))
            kept = pool[values >= values.max() - tolerance]
            if len(kept) < len(pool):
                depth = place
            pool = kept
        for member in pool:
            parents[member] += 1 / len(pool) / len(orders)
        depths[depth] += 1 / len(orders)
    return parents, dict(depths)


@pytest.mark.parametrize("limit", [None, 1, 2])
@pytest.mark.parametrize("scores", [REALS, CROWD, GRADES])
def test_dynamic_epsilon_follows_the_enumerated_orders(scores, limit):
    report = lexicase_report(
        scores.double(),
        1500,
        epsilon="mad",
        epsilon_mode="dynamic",
        cases_per_selection=limit,
        generator=generator(4),
    )
    parents, depths = enumerate_dynamic(scores, limit)
    assert_fits(report.parents.bincount(minlength=len(scores)).tolist(), parents)
    assert_fits([int((report.depth == depth).sum()) for depth in depths], list(depths.values()))
    assert report.distinct == len(scores.unique(dim=0))


def test_dynamic_epsilon_shrinks_with_the_pool():
    # Case 0 keeps the two with 9, and their deviation on case 1 is 1/2: member 0 falls. That of
    # the population is 3, which would keep both. Case 1 first keeps member 2 alone.
    scores = torch.tensor([[9.0, 0.0], [9.0, 1.0], [0.0, 9.0], [0.0, 4.0], [0.0, 5.0]])
    chances = {"dynamic": [0, 1 / 2, 1 / 2], "semi-dynamic": [1 / 4, 1 / 4, 1 / 2]}
    for mode, chance in chances.items():
        parents = lexicase_selection(
            scores, 1000, epsilon="mad", epsilon_mode=mode, generator=generator()
        )
        assert_fits(parents.bincount(minlength=3).tolist(), chance)


def test_dynamic_mode_matters_to_real_scores_and_mad_only():
    for scores, epsilon in ((REALS > 0.3, "mad"), (REALS, 0.15), (REALS, None)):
        selected = [
            lexicase_selection(
                scores, 100, epsilon=epsilon, epsilon_mode=mode, generator=generator()
            )
            for mode in ("dynamic", "semi-dynamic")
        ]
        assert torch.equal(*selected)
    equal = torch.ones(4, 3)
    report = lexicase_report(
        equal, 400, epsilon="mad", epsilon_mode="dynamic", generator=generator()
    )
    assert report.depth.eq(0).all()
    assert_fits(report.parents.bincount(minlength=4).tolist(), [1 / 4] * 4)
