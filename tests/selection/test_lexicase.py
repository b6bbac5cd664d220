"""Lexicase selection against enumerated probabilities, a second implementation, and by property."""

import itertools
import math
from collections import Counter
from collections.abc import Sequence

import lexicase as reference
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2_contingency, chisquare
from torch import Tensor

from popl_rl.selection import behaviours
from popl_rl.selection.lexicase import SelectionReport, lexicase_report, lexicase_selection
from popl_rl.selection.mad import mad
from popl_rl.selection.pools import PassPools, ScorePools
from popl_rl.selection.rounds import Round

DRAWS = 3000


def generator(seed: int = 0, device: str = "cpu") -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


def enumerate_orders(
    scores: Tensor, tolerance: Sequence[float], limit: int | None = None
) -> tuple[list[float], dict[int, float]]:
    """Chance of each parent, and of each depth, over all orders of the cases."""
    rows = scores.double().tolist()
    parents = [0.0] * len(rows)
    depths: Counter[int] = Counter()
    orders = list(itertools.permutations(range(scores.shape[1])))
    for order in orders:
        pool, depth = list(range(len(rows))), 0
        for place, case in enumerate(order[:limit], start=1):
            bar = max(rows[member][case] for member in pool) - tolerance[case]
            kept = [member for member in pool if rows[member][case] >= bar]
            if len(kept) < len(pool):
                depth = place
            pool = kept
        for member in pool:
            parents[member] += 1 / len(pool) / len(orders)
        depths[depth] += 1 / len(orders)
    return parents, dict(depths)


def assert_fits(counts: Sequence[float], chances: Sequence[float]) -> None:
    """Chi-square test of counts; what has no chance must not occur at all."""
    observed, expected = np.asarray(counts, float), np.asarray(chances) * sum(counts)
    possible = expected > 0
    assert observed[~possible].sum() == 0
    if possible.sum() > 1:
        assert chisquare(observed[possible], expected[possible]).pvalue > 1e-4


def assert_distribution(
    report: SelectionReport, scores: Tensor, tolerance: Sequence[float], limit: int | None = None
) -> None:
    parents, depths = enumerate_orders(scores, tolerance, limit)
    assert_fits(report.parents.bincount(minlength=len(scores)).tolist(), parents)
    found = Counter(report.depth.tolist())
    assert set(found) <= set(depths)
    assert_fits([found[depth] for depth in depths], list(depths.values()))


@pytest.fixture(params=["drawn", "settled", "chunked"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run on each way through the engine: they differ in speed and must not in outcome."""
    if request.param == "settled":
        monkeypatch.setattr(Round, "settling_work", lambda *_: 0.0)
        monkeypatch.setattr(PassPools, "block", property(lambda _: 1, lambda *_: None), False)
    if request.param == "chunked":
        for pools in (PassPools, ScorePools):
            monkeypatch.setattr(pools, "chunk", property(lambda _: 97, lambda *_: None), False)
    return str(request.param)


# Small populations with twins, dominated members, ties, and a case on which all agree.
PASSES = torch.tensor(
    [
        [1, 1, 0, 0, 1],
        [0, 0, 1, 1, 1],
        [1, 0, 1, 0, 1],
        [1, 0, 1, 0, 1],
        [0, 1, 0, 1, 1],
        [0, 1, 0, 0, 1],
    ],
    dtype=torch.bool,
)
GRADES = torch.tensor([[3, 0, 1, 2], [1, 3, 1, 2], [3, 2, 0, 2], [2, 2, 2, 2], [2, 2, 2, 2]])
REALS = torch.tensor(
    [
        [0.9, -1.0, 0.3, 5.0],
        [0.8, -0.2, 0.1, 4.5],
        [0.1, -0.1, 0.4, 4.8],
        [0.7, -0.6, 0.9, 1.0],
        [0.2, -3.0, 0.8, 4.9],
    ]
)


def test_parents_of_a_population_worked_by_hand():
    # Case 0 first: member 0. Case 1 first: 0 and 2, and whatever comes next leaves 0, since nobody
    # of the two passes case 2. Case 2 first: member 1. So 2/3, 1/3, 0.
    passes = torch.tensor([[1, 1, 0], [0, 0, 1], [0, 1, 0]], dtype=torch.bool)
    parents = lexicase_selection(passes, DRAWS, generator=generator())
    assert parents.dtype == torch.int64
    assert parents.shape == (DRAWS,)
    assert_fits(parents.bincount(minlength=3).tolist(), [2 / 3, 1 / 3, 0])


@pytest.mark.parametrize("limit", [None, 1, 2, 3])
@pytest.mark.parametrize("scores", [PASSES, GRADES, REALS], ids=["bool", "int", "real"])
def test_parents_and_depths_follow_the_enumerated_orders(way, scores, limit):
    report = lexicase_report(scores, DRAWS, cases_per_selection=limit, generator=generator(1))
    assert_distribution(report, scores, [0.0] * scores.shape[1], limit)


@pytest.mark.parametrize("limit", [None, 2])
@pytest.mark.parametrize("epsilon", [0.0, 0.15, 1.0, [0.15, 0.5, 0.0, 3.0], "mad"])
def test_semi_dynamic_epsilon_follows_the_enumerated_orders(way, epsilon, limit):
    scores = REALS.double()
    tolerance = mad(scores).tolist() if epsilon == "mad" else epsilon
    tolerance = [tolerance] * 4 if isinstance(tolerance, float) else tolerance
    report = lexicase_report(
        scores,
        DRAWS,
        epsilon=torch.tensor(epsilon) if isinstance(epsilon, list) else epsilon,
        cases_per_selection=limit,
        generator=generator(2),
    )
    assert_distribution(report, scores, tolerance, limit)


@pytest.mark.parametrize("epsilon", [0.15, torch.tensor([0.15, 0.5, 0.0, 3.0]), "mad"])
def test_static_epsilon_is_lexicase_on_the_passes_of_the_population(epsilon):
    scores = REALS.double()
    tolerance = mad(scores) if isinstance(epsilon, str) else epsilon
    passes = scores >= scores.amax(0) - tolerance
    report = lexicase_report(
        scores, DRAWS, epsilon=epsilon, epsilon_mode="static", generator=generator(3)
    )
    assert_distribution(report, passes, [0.0] * 4)
    assert report.distinct == len(passes.unique(dim=0))


def test_modes_of_epsilon_differ_in_whom_a_member_is_compared_with():
    # With case 0 first, members 0 and 1 stay. In case 1 the best of these two is 3, so member 0
    # falls; but compared with member 2, whose 10 is the best of the population, both fail alike.
    scores = torch.tensor([[10.0, 0.0], [10.0, 3.0], [0.0, 10.0]])
    chances = {"semi-dynamic": [0, 1 / 2, 1 / 2], "static": [1 / 4, 1 / 4, 1 / 2]}
    for mode, chance in chances.items():
        parents = lexicase_selection(
            scores, DRAWS, epsilon=1.0, epsilon_mode=mode, generator=generator()
        )
        assert_fits(parents.bincount(minlength=3).tolist(), chance)


def test_epsilon_changes_passes_only_from_one_upwards():
    for epsilon in (0.9, "mad"):
        report = lexicase_report(PASSES, DRAWS, epsilon=epsilon, generator=generator())
        assert_distribution(report, PASSES, [0.0] * 5)
    loose = torch.tensor([0.0, 0.0, 1.0, 1.5, 0.0])
    report = lexicase_report(PASSES, DRAWS, epsilon=loose, generator=generator())
    assert_distribution(report, PASSES, loose.tolist())


def test_epsilon_is_not_rounded_to_the_scores():
    report = lexicase_report(GRADES, DRAWS, epsilon=1.5, generator=generator())
    assert_distribution(report, GRADES, [1.5] * 4)
    # In single precision 0.1 is a little more than 0.1, and would save member 1.
    scores = torch.tensor([[0.1], [-1e-12]], dtype=torch.float64)
    assert lexicase_selection(scores, 50, epsilon=0.1, generator=generator()).eq(0).all()


def test_median_absolute_deviation_counts_members_not_behaviours():
    # Deviations of 0, 0, 0, 4, 9 from the median 0: their median is 0, so member 3 never stays
    # with member 4. Over the three behaviours it would be 4, and member 4 would not win alone.
    scores = torch.tensor([[0.0], [0.0], [0.0], [4.0], [9.0]])
    parents = lexicase_selection(scores, 200, epsilon="mad", generator=generator())
    assert set(parents.tolist()) == {4}


@pytest.mark.parametrize("kind", ["plain", "number", "mad"])
def test_distribution_agrees_with_another_implementation(kind):
    scores = torch.randn(14, 25, generator=generator(5), dtype=torch.float64)
    if kind == "plain":
        scores = (scores > 0.3).double()
        theirs = reference.lexicase_selection(scores.numpy(), DRAWS, seed=1)
        ours = lexicase_selection(scores > 0.3, DRAWS, generator=generator(6))
    else:
        theirs = reference.epsilon_lexicase_selection(
            scores.numpy(), DRAWS, epsilon=None if kind == "mad" else 0.8, seed=1
        )
        ours = lexicase_selection(
            scores, DRAWS, epsilon="mad" if kind == "mad" else 0.8, generator=generator(6)
        )
    table = np.stack([np.bincount(theirs, minlength=14), ours.bincount(minlength=14).numpy()])
    table = table[:, table.sum(0) > 0]
    assert table.shape[1] > 3
    assert chi2_contingency(table).pvalue > 1e-4


populations = st.integers(1, 9).flatmap(
    lambda cases: st.lists(
        st.lists(st.integers(-2, 2), min_size=cases, max_size=cases), min_size=1, max_size=20
    )
)


@settings(deadline=None)
@given(rows=populations, kind=st.sampled_from(["bool", "int", "float"]), seed=st.integers(0, 9))
def test_no_parent_is_dominated_within_the_population(rows, kind, seed):
    scores = as_kind(rows, kind)
    chosen = scores[lexicase_selection(scores, 12, generator=generator(seed))]
    no_worse = (scores[None] >= chosen[:, None]).all(2)
    better = (scores[None] > chosen[:, None]).any(2)
    assert not (no_worse & better).any()


@settings(deadline=None)
@given(
    rows=populations,
    kind=st.sampled_from(["bool", "int", "float"]),
    seed=st.integers(0, 9),
    data=st.data(),
)
def test_order_and_copies_of_members_change_nothing_but_names(rows, kind, seed, data):
    scores = as_kind(rows, kind)
    order = data.draw(st.permutations(range(len(rows))))
    copies = data.draw(st.lists(st.sampled_from(range(len(rows))), max_size=5))
    renamed = torch.cat([scores[list(order)], scores[copies]])
    behaviours = scores[lexicase_selection(scores, 12, generator=generator(seed))]
    again = renamed[lexicase_selection(renamed, 12, generator=generator(seed))]
    assert torch.equal(behaviours, again)


def as_kind(rows: list[list[int]], kind: str) -> Tensor:
    scores = torch.tensor(rows)
    return scores > 0 if kind == "bool" else scores.float() / 3 if kind == "float" else scores


@pytest.mark.parametrize("seed", range(5))
def test_order_of_the_cases_does_not_matter(seed):
    cases = torch.randperm(5, generator=generator(seed))
    report = lexicase_report(PASSES[:, cases], DRAWS, generator=generator(seed))
    assert_distribution(report, PASSES, [0.0] * 5)


def test_twins_share_the_chance_of_their_behaviour():
    passes = torch.tensor([[1, 0], [0, 1], [0, 1], [0, 1]], dtype=torch.bool)
    parents = lexicase_selection(passes, DRAWS, generator=generator())
    assert_fits(parents.bincount(minlength=4).tolist(), [1 / 2, 1 / 6, 1 / 6, 1 / 6])


def test_a_final_tie_is_broken_among_members_not_behaviours():
    # Epsilon never separates 0.0 from 0.1, and two members score 0.1.
    scores = torch.tensor([[0.0], [0.1], [0.1]])
    parents = lexicase_selection(scores, DRAWS, epsilon=1.0, generator=generator())
    assert_fits(parents.bincount(minlength=3).tolist(), [1 / 3] * 3)


def test_seed_decides_everything():
    scores = torch.rand(60, 300, generator=generator()) < 0.7
    for values, epsilon in ((scores, None), (torch.rand(60, 300, generator=generator()), "mad")):
        draws = [
            lexicase_report(values, 500, epsilon=epsilon, generator=generator(seed))
            for seed in (1, 1, 2)
        ]
        assert torch.equal(draws[0].parents, draws[1].parents)
        assert torch.equal(draws[0].depth, draws[1].depth)
        assert not torch.equal(draws[0].parents, draws[2].parents)
        plain = lexicase_selection(values, 500, epsilon=epsilon, generator=generator(1))
        assert torch.equal(plain, draws[0].parents)


def test_report_of_a_population_worked_by_hand():
    # Two behaviours that differ in case 0 only: it decides, and in a random order of three cases
    # it comes first, second or third. Member 0 always wins.
    passes = torch.tensor([[1, 1, 0], [0, 1, 0], [0, 1, 0]], dtype=torch.bool)
    report = lexicase_report(passes, DRAWS, generator=generator())
    assert report.distinct == 2
    assert report.effective == 1.0
    assert set(report.parents.tolist()) == {0}
    assert_fits(report.depth.bincount(minlength=4).tolist(), [0, 1 / 3, 1 / 3, 1 / 3])


def test_effective_number_counts_behaviours_with_equal_shares():
    report = lexicase_report(torch.eye(8).bool(), 4000, generator=generator())
    assert report.distinct == 8
    assert 7.9 < report.effective <= 8
    twins = lexicase_report(torch.ones(8, 3).bool(), 100, generator=generator())
    assert (twins.distinct, twins.effective) == (1, 1.0)
    assert twins.depth.eq(0).all()
    assert len(twins.parents.unique()) == 8


def test_one_case_per_selection_selects_the_best_of_a_random_case():
    report = lexicase_report(
        torch.eye(4).bool(), DRAWS, cases_per_selection=1, generator=generator()
    )
    assert report.depth.eq(1).all()
    assert_fits(report.parents.bincount(minlength=4).tolist(), [1 / 4] * 4)


def test_siblings_that_differ_in_one_case_of_many_are_told_apart():
    # Each of 40 members fails one case of its own out of 5000; 4960 cases are passed by all. The
    # one whose case comes last in the order wins: everyone has the same chance, and the last but
    # one of the 40 cases decides. Its mean place is 5001 * 39 / 41.
    passes = torch.ones(40, 5000, dtype=torch.bool)
    passes[torch.arange(40), torch.arange(40) * 100] = False
    report = lexicase_report(passes, 4000, generator=generator())
    assert_fits(report.parents.bincount(minlength=40).tolist(), [1 / 40] * 40)
    assert math.isclose(report.depth.double().mean(), 5001 * 39 / 41, rel_tol=0.01)


def test_members_within_epsilon_everywhere_end_in_a_draw():
    scores = torch.rand(30, 400, generator=generator())
    parents = lexicase_selection(scores, 1000, epsilon=1.0, generator=generator())
    assert_fits(parents.bincount(minlength=30).tolist(), [1 / 30] * 30)


@pytest.mark.parametrize(
    "dtype",
    [torch.uint8, torch.int8, torch.int16, torch.int32, torch.float16, torch.bfloat16],
)
def test_every_ordered_dtype_gives_the_same_distribution(dtype):
    report = lexicase_report(GRADES.to(dtype), DRAWS, generator=generator())
    assert_distribution(report, GRADES, [0.0] * 4)


def test_views_and_gradients_are_no_obstacle():
    scores = REALS.double().T.contiguous().T.requires_grad_()
    assert not scores.is_contiguous()
    for epsilon in (None, "mad"):
        report = lexicase_report(scores, DRAWS, epsilon=epsilon, generator=generator())
        tolerance = [0.0] * 4 if epsilon is None else mad(scores).tolist()
        assert_distribution(report, scores.detach(), tolerance)
    report = lexicase_report(PASSES.T.contiguous().T, DRAWS, generator=generator())
    assert_distribution(report, PASSES, [0.0] * 5)


def test_infinite_scores_and_both_zeros_are_ordered():
    scores = torch.tensor([[torch.inf, -torch.inf], [-torch.inf, -0.0], [-torch.inf, 0.0]])
    for epsilon in (None, 0.5):
        report = lexicase_report(scores, DRAWS, epsilon=epsilon, generator=generator())
        assert report.distinct == 2
        assert_fits(report.parents.bincount(minlength=3).tolist(), [1 / 2, 1 / 4, 1 / 4])


def test_clashing_fingerprints_do_no_harm(monkeypatch):
    monkeypatch.setattr(behaviours, "fingerprints", lambda scores: scores.new_zeros(len(scores)))
    report = lexicase_report(PASSES, DRAWS, generator=generator())
    assert report.distinct == 5
    assert_distribution(report, PASSES, [0.0] * 5)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("limit", [None, 2])
@pytest.mark.parametrize(
    ("scores", "epsilon"), [(PASSES, None), (GRADES, None), (REALS, 0.15), (REALS, "mad")]
)
def test_selection_on_cuda_follows_the_enumerated_orders(way, scores, epsilon, limit):
    tolerance = [epsilon or 0.0] * scores.shape[1]
    if epsilon == "mad":
        tolerance = mad(scores).tolist()
    report = lexicase_report(
        scores.cuda(),
        DRAWS,
        epsilon=epsilon,
        cases_per_selection=limit,
        generator=generator(1, "cuda"),
    )
    assert report.parents.is_cuda
    assert report.depth.is_cuda
    assert_distribution(report, scores, tolerance, limit)
