"""Speed of lexicase selection beside the PyPI package lexicase.

    pytest tests/benchmarks/bench_lexicase.py -m benchmark

How it grows: growth.py.
"""

from importlib.util import find_spec
from typing import Any

import lexicase as reference
import pytest
import torch
from torch import Tensor

from popl_rl.selection.lexicase import lexicase_given_first, lexicase_report, lexicase_selection
from popl_rl.selection.mad import mad

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

THEIRS = f"lexicase {reference.__version__}"


def coin_flips(members: int, cases: int, seed: int = 0) -> Tensor:
    passes = torch.empty(members, cases, dtype=torch.bool)
    return passes.random_(generator=torch.Generator().manual_seed(seed))


def test_distinct_behaviours(race: Any) -> None:
    passes = coin_flips(1000, 100_000)
    generator = torch.Generator().manual_seed(1)
    ratio = race(
        "1000 selections, 1000 x 100 000 passes, all distinct",
        lambda: lexicase_selection(passes, 1000, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 1000),
        rounds=7,
        reference=THEIRS,
        target=15,
    )
    assert ratio > 15


def test_twenty_behaviours(race: Any) -> None:
    draws = torch.Generator().manual_seed(1)
    passes = coin_flips(20, 100_000)[torch.randint(20, (1000,), generator=draws)]
    ratio = race(
        "the same with 20 distinct behaviours (reference: 2 selections, times 500)",
        lambda: lexicase_selection(passes, 1000, generator=draws),
        lambda: reference.lexicase_selection(passes.numpy(), 2),
        rounds=3,
        reference=THEIRS,
        target=500,
        scale=500,
    )
    assert ratio > 500


def test_small_population(race: Any) -> None:
    passes = coin_flips(100, 2048)
    generator = torch.Generator().manual_seed(1)
    ratio = race(
        "100 selections, 100 x 2048 passes",
        lambda: lexicase_selection(passes, 100, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 100),
        rounds=21,
        reference=THEIRS,
        target=15,
        number=20,
    )
    # About 250 calls into torch take a millisecond, however small their tensors; numba saves most.
    assert ratio > (4 if find_spec("numba") is None else 12)


def test_median_absolute_deviation(race: Any) -> None:
    generator = torch.Generator().manual_seed(1)
    scores = torch.randn(1000, 20_000, generator=generator)
    ratio = race(
        "1000 selections, 1000 x 20 000 real scores, epsilon='mad'",
        lambda: lexicase_selection(scores, 1000, epsilon="mad", generator=generator),
        lambda: reference.epsilon_lexicase_selection(scores.numpy(), 1000),
        rounds=7,
        reference=THEIRS,
        target=10,
    )
    # 3700 deviations are needed, at two medians of 1000 values each.
    assert ratio > 10


def test_dynamic_epsilon(race: Any) -> None:
    """One selection after the other, beside the mode that takes all together."""
    generator = torch.Generator().manual_seed(1)
    scores = torch.randn(200, 2000, generator=generator)

    def select(mode: Any) -> Tensor:
        return lexicase_selection(
            scores, 100, epsilon="mad", epsilon_mode=mode, generator=generator
        )

    race(
        "100 selections, 200 x 2000 real scores, epsilon='mad', dynamic",
        lambda: select("dynamic"),
        lambda: select("semi-dynamic"),
        reference="semi-dynamic",
        target=0,
        rounds=5,
    )


def test_given_first_cases(race: Any) -> None:
    """A generation of 32 members and 200 raters, beside one selection for each first case."""
    generator = torch.Generator().manual_seed(1)
    values = (torch.rand(32, 200, 20, generator=generator) < 0.8).float().mean(-1)
    tolerance = mad(values)
    first = torch.randint(200, (32,), generator=generator)

    def one_by_one() -> None:
        for case in first.unique().tolist():
            column = values[:, case]
            pool = values[column >= column.max() - tolerance[case]]
            count = int((first == case).sum())
            lexicase_report(pool, count, epsilon=tolerance, generator=generator)

    ratio = race(
        "32 selections with given first cases, 32 x 200 real scores",
        lambda: lexicase_given_first(values, first, epsilon=tolerance, generator=generator),
        one_by_one,
        rounds=21,
        reference="one lexicase_report for each first case",
        target=10,
        number=5,
    )
    assert ratio > 7


@pytest.mark.parametrize("share", [0.7, 0.9, 0.99])
def test_most_cases_passed(race: Any, share: float) -> None:
    generator = torch.Generator().manual_seed(1)
    passes = torch.rand(1000, 20_000, generator=generator) < share
    race(
        f"1000 selections, 1000 x 20 000 passes, {share:.0%} passed (reference: 100, times 10)",
        lambda: lexicase_selection(passes, 1000, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 100),
        rounds=3,
        reference=THEIRS,
        target=1,
        scale=10,
    )


def test_siblings(race: Any) -> None:
    """Every member has a sibling that differs in 10 of 20 000 cases, as after a small mutation."""
    generator = torch.Generator().manual_seed(1)
    passes = coin_flips(500, 20_000)
    siblings = passes.clone()
    flips = torch.randint(20_000, (500, 10), generator=generator)
    siblings.scatter_(1, flips, ~siblings.gather(1, flips))
    passes = torch.cat([passes, siblings])
    race(
        "1000 selections, 500 pairs of siblings x 20 000 passes (reference: 10, times 100)",
        lambda: lexicase_selection(passes, 1000, generator=generator),
        lambda: reference.lexicase_selection(passes.numpy(), 10),
        rounds=3,
        reference=THEIRS,
        target=1,
        scale=100,
    )
