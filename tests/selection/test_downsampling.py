"""Down-sampling of cases: at random, and by farthest-first traversal."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare
from torch import Tensor

from popl_rl.selection.downsampling import downsample, informed_downsample, spread_out
from popl_rl.selection.lexicase import lexicase_selection


def generator(seed: int = 0, device: str = "cpu") -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


@settings(deadline=None)
@given(num_cases=st.integers(1, 50), data=st.data(), seed=st.integers(0, 99))
def test_random_sample_is_of_distinct_cases(num_cases, data, seed):
    num_kept = data.draw(st.integers(1, num_cases))
    cases = downsample(num_cases, num_kept, generator=generator(seed))
    assert cases.dtype == torch.int64
    assert cases.shape == (num_kept,)
    assert len(set(cases.tolist())) == num_kept
    assert 0 <= int(cases.min()) <= int(cases.max()) < num_cases


def test_every_pair_of_cases_is_sampled_equally_often():
    draws = generator()
    pairs = [tuple(sorted(downsample(5, 2, generator=draws).tolist())) for _ in range(1000)]
    counts = [pairs.count((a, b)) for a in range(5) for b in range(a + 1, 5)]
    assert chisquare(counts).pvalue > 1e-4


def test_seed_decides_the_sample():
    passes = torch.rand(20, 80, generator=generator()) < 0.5
    for draw in (
        lambda seed: downsample(80, 9, generator=generator(seed)),
        lambda seed: informed_downsample(passes, 9, num_members=8, generator=generator(seed)),
    ):
        assert torch.equal(draw(1), draw(1))
        assert not torch.equal(draw(1), draw(2))


matrices = st.integers(1, 40).flatmap(
    lambda cases: st.lists(
        st.lists(st.booleans(), min_size=cases, max_size=cases), min_size=1, max_size=6
    )
)


@settings(max_examples=40, deadline=None)
@given(rows=matrices, data=st.data(), seed=st.integers(0, 99))
def test_each_case_kept_is_farthest_from_those_before_it(rows, data, seed):
    passes = torch.tensor(rows)
    num_cases = passes.shape[1]
    num_kept = data.draw(st.integers(1, num_cases))
    kept = informed_downsample(passes, num_kept, generator=generator(seed)).tolist()
    assert len(set(kept)) == num_kept
    vectors = passes.T.numpy()
    for step in range(1, num_kept):
        nearest = np.array(
            [
                min((vectors[case] != vectors[k]).sum() for k in kept[:step])
                for case in range(num_cases)
            ]
        )
        others = [case for case in range(num_cases) if case not in kept[:step]]
        assert nearest[kept[step]] == nearest[others].max()


def test_traversal_worked_by_hand():
    # Solve vectors 000, 001, 011, 111: from an end it goes to the other end, from 001 to 111, from
    # 011 to 000. Only then come cases at distance 1.
    passes = torch.tensor([[0, 0, 0, 1], [0, 0, 1, 1], [0, 1, 1, 1]], dtype=torch.bool)
    second = {0: 3, 1: 3, 2: 0, 3: 0}
    for seed in range(12):
        kept = informed_downsample(passes, 4, generator=generator(seed)).tolist()
        assert kept[1] == second[kept[0]]


def test_ties_are_broken_at_random():
    # After case 0 the four others are equally far, from it and from each other.
    passes = torch.eye(5).bool()
    draws = generator()
    kept = [tuple(informed_downsample(passes, 2, generator=draws).tolist()) for _ in range(1000)]
    counts = [kept.count((a, b)) for a in range(5) for b in range(5) if a != b]
    assert chisquare(counts).pvalue > 1e-4


def test_a_rare_case_stays_in_where_chance_drops_it():
    # 999 cases that most pass alike, and one that only member 0 passes.
    passes = torch.ones(50, 1000, dtype=torch.bool)
    passes[0] = False
    passes[:, 421] = ~passes[:, 421]
    for seed in range(5):
        assert 421 in informed_downsample(passes, 2, num_members=50, generator=generator(seed))
    kept = informed_downsample(passes, 10, generator=generator())
    parents = lexicase_selection(passes[:, kept], 400, generator=generator())
    assert 0 in parents


def test_synonymous_cases_are_kept_once_before_any_is_kept_twice():
    passes = torch.rand(30, 6, generator=generator()) < 0.5
    repeated = passes.repeat_interleave(torch.tensor([1, 50, 1, 200, 1, 3]), 1)
    kept = informed_downsample(repeated, 8, generator=generator())
    assert len(repeated[:, kept[:6]].unique(dim=1).T) == 6


def test_sample_of_members_limits_what_is_seen():
    passes = torch.rand(200, 30, generator=generator()) < 0.5
    vectors_seen = 2  # of one member: passed or failed
    kept = informed_downsample(passes, 30, num_members=1, generator=generator())
    assert any(len(passes[m, kept[:vectors_seen]].unique()) == 2 for m in range(200))
    assert sorted(kept.tolist()) == list(range(30))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda g: downsample(0, 1, generator=g),
            ValueError,
            "num_cases must be at least 1, got 0",
        ),
        (lambda g: downsample(5, 0, generator=g), ValueError, "num_kept must be from 1 to 5"),
        (lambda g: downsample(5, 6, generator=g), ValueError, "the number of cases, got 6"),
        (
            lambda g: downsample(5, 0.5, generator=g),
            TypeError,
            "num_kept must be an int, got float",
        ),
        (lambda _: downsample(5, 2, generator=3), TypeError, "generator must be a torch.Generator"),
        (
            lambda g: informed_downsample(torch.rand(3, 3), 2, generator=g),
            TypeError,
            "passes must be bool, got torch.float32; say what counts",
        ),
        (
            lambda g: informed_downsample([[True]], 1, generator=g),
            TypeError,
            "passes must be a torch.Tensor, got list",
        ),
        (
            lambda g: informed_downsample(torch.ones(3).bool(), 1, generator=g),
            ValueError,
            r"passes must be a \[member, case\] matrix",
        ),
        (
            lambda g: informed_downsample(torch.ones(0, 3).bool(), 1, generator=g),
            ValueError,
            "passes must have at least one member",
        ),
        (
            lambda g: informed_downsample(torch.ones(2, 3).bool(), 4, generator=g),
            ValueError,
            "num_kept must be from 1 to 3, the number of cases, got 4",
        ),
        (
            lambda g: informed_downsample(torch.ones(2, 3).bool(), 2, num_members=0, generator=g),
            ValueError,
            "num_members must be at least 1, got 0",
        ),
        (
            lambda g: informed_downsample(torch.ones(2, 3, device="meta").bool(), 2, generator=g),
            ValueError,
            "generator must be on the device of passes",
        ),
    ],
)
def test_mistakes_are_explained(call, error, message):
    with pytest.raises(error, match=message):
        call(generator())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_sampling_on_cuda():
    def distances(passes: Tensor, kept: Tensor) -> Tensor:
        vectors = passes[:, kept].T.float()
        return (vectors[:, None] != vectors).sum(2)

    passes = torch.rand(40, 500, device="cuda") < 0.5
    cases = downsample(500, 20, generator=generator(0, "cuda"))
    kept = informed_downsample(passes, 20, generator=generator(0, "cuda"))
    assert cases.is_cuda
    assert kept.is_cuda
    assert len(kept.unique()) == 20
    off_diagonal = ~torch.eye(20, dtype=torch.bool, device="cuda")
    spread = distances(passes, kept)[off_diagonal].min()
    assert spread > distances(passes, cases)[off_diagonal].min()


def test_those_unlike_each_other_are_chosen(generator):
    """Nine alike and one apart: whoever comes first, the second choice is from the other side."""
    similarity = torch.ones(10, 10)
    similarity[9, :9] = similarity[:9, 9] = -1.0
    for _ in range(5):
        chosen = spread_out(lambda some: similarity[some], 10, 2, generator=generator)
        assert len(chosen) == 2
        assert (chosen == 9).sum() == 1


def test_more_than_there_are_repeat(generator):
    assert len(spread_out(lambda some: torch.eye(3)[some], 3, 7, generator=generator)) == 7
    assert set(spread_out(lambda some: torch.eye(3)[some], 3, 3, generator=generator).tolist()) == {
        0,
        1,
        2,
    }
