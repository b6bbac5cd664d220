"""Selection with compiled kernels and without: equal to the bit, and equally distributed."""

import pytest
import torch

from popl_rl.selection import compiled, lexicase
from popl_rl.selection.pools import PassPools
from popl_rl.selection.rounds import Round

pytest.importorskip("numba", reason="the extra 'fast'")


@pytest.fixture
def without(monkeypatch):
    """Runs something without the kernels."""

    def run(work):
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "find_spec", lambda _: None)
            compiled.find_kernels.cache_clear()
            try:
                return work()
            finally:
                compiled.find_kernels.cache_clear()

    return run


def report_of(passes, seed, limit, first):
    generator = torch.Generator().manual_seed(seed)
    if first is not None:
        return lexicase.lexicase_given_first(passes, first, generator=generator)
    return lexicase.lexicase_report(passes, 200, cases_per_selection=limit, generator=generator)


def populations():
    """Passes of many shapes, with twins, cases that all pass, and siblings that settle late."""
    draws = torch.Generator().manual_seed(0)
    for members, cases, share in ((1, 1, 0.5), (3, 2, 0.5), (7, 9, 0.6), (64, 300, 0.8)):
        yield torch.rand(members, cases, generator=draws) < share
    yield torch.rand(9, 70, generator=draws)[torch.arange(40) % 9] < 0.5
    passes = torch.rand(100, 2048, generator=draws) < 0.5
    yield passes
    siblings = passes[:20].clone()
    siblings[:, :2] ^= True
    yield torch.cat([passes, siblings])
    passes[:, ::3] = True
    yield passes
    yield passes.T[:130].contiguous().T  # views, of which rows are no whole words
    yield passes[:, 3:67]
    yield torch.from_numpy(passes.numpy()[1:, 5:77])


@pytest.mark.parametrize("way", ["all cases", "three cases", "given first"])
@pytest.mark.parametrize("settled", [False, True])
def test_equal_to_the_bit(without, way, settled, monkeypatch):
    if settled:
        monkeypatch.setattr(Round, "settling_work", lambda *_: 0.0)
        monkeypatch.setattr(PassPools, "block", property(lambda _: 1, lambda *_: None), False)
    for seed, passes in enumerate(populations()):
        cases = passes.shape[1]
        limit = min(3, cases) if way == "three cases" else None
        first = torch.arange(50) % cases if way == "given first" else None
        fast = report_of(passes, seed, limit, first)
        slow = without(lambda args=(passes, seed, limit, first): report_of(*args))
        assert torch.equal(fast.parents, slow.parents)
        assert torch.equal(fast.depth, slow.depth)
        assert (fast.distinct, fast.effective) == (slow.distinct, slow.effective)


def test_kernels_are_for_passes_in_the_processors_memory(without):
    assert compiled.kernels_for(torch.ones(2, 3, dtype=torch.bool)) is not None
    assert compiled.kernels_for(torch.ones(2, 3)) is None
    assert compiled.kernels_for(torch.ones(2, 3, dtype=torch.bool, device="meta")) is None
    assert without(lambda: compiled.kernels_for(torch.ones(2, 3, dtype=torch.bool))) is None
