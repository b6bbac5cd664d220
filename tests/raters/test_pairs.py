"""Which pairs may be asked about: every fifth start, and every pair asked, is used only once."""

import pytest
import torch
from tensordict import TensorDict

from popl_rl.raters.pairs import PairPool, held_out_pool, training_pool


def segments_from(starts, each):
    """Segments of one step, ``each`` of them from each of ``starts`` states."""
    start = torch.arange(starts).repeat_interleave(each).unsqueeze(-1)
    return TensorDict({"info": {"start": start}}, [starts * each, 1])


def unordered(pairs):
    return {frozenset(pair) for pair in pairs.tolist()}


NOTHING = torch.empty(0, 2, dtype=torch.long)


def test_pairs_that_were_asked_are_never_drawn_in_either_order(generator):
    asked = torch.tensor([[0, 1], [3, 2]])
    pairs = PairPool(4, asked=asked).draw(500, generator=generator)
    everything = {frozenset((i, j)) for i in range(4) for j in range(i)}
    assert unordered(pairs) == everything - unordered(asked)


def test_without_asked_pairs_nothing_changes_in_what_is_drawn():
    drawn = [
        PairPool(9, asked=asked).draw(50, generator=torch.Generator().manual_seed(3))
        for asked in (None, NOTHING)
    ]
    assert torch.equal(*drawn)


def test_a_pool_in_which_all_was_asked_is_refused(generator):
    asked = torch.tensor([[0, 1], [1, 2], [2, 0]])
    with pytest.raises(ValueError, match=r"all pairs of the 3 segments .* collect more segments"):
        PairPool(3, asked=asked).draw(5, generator=generator)


@pytest.mark.parametrize(("starts", "kept"), [(3, 2), (5, 2), (10, 2), (15, 3), (500, 100)])
def test_a_fifth_of_the_starts_is_kept_for_evaluation(starts, kept, generator):
    segments = segments_from(starts, each=3)
    shown = [
        set((pool.draw(20 * len(segments), generator=generator) // 3).flatten().tolist())
        for pool in (training_pool(segments), held_out_pool(segments, NOTHING))
    ]
    assert shown == [set(range(starts - kept)), set(range(starts - kept, starts))]


def test_pairs_of_kept_starts_that_were_asked_all_the_same_are_left_out(generator):
    """Loaded preferences may be about any segments."""
    asked = torch.tensor([[8, 6], [9, 11]])
    pairs = held_out_pool(segments_from(4, each=3), asked).draw(300, generator=generator)
    assert unordered(pairs) == {frozenset(p) for p in [(6, 7), (7, 8), (9, 10), (10, 11)]}


def test_the_number_of_pairs_by_hand():
    """Of 4 segments 6 pairs; two starts of three segments have 3 each; asked ones are left out."""
    assert PairPool(4).num_pairs == 6
    assert PairPool(4, asked=torch.tensor([[0, 1], [1, 0], [3, 2]])).num_pairs == 4
    assert PairPool(6, allowed=torch.arange(4), asked=torch.tensor([[0, 1], [4, 5]])).num_pairs == 5
    asked = torch.tensor([[8, 6], [9, 11], [0, 1], [6, 9]])
    pool = held_out_pool(segments_from(4, each=3), asked)
    assert pool.num_pairs == 6 - 2
    assert pool.num_pairs == len(unordered(pool.draw(300, generator=torch.Generator())))


@pytest.mark.parametrize("starts", [1, 2])
def test_too_few_starts_to_keep_some_are_refused(starts):
    segments = segments_from(starts, each=4)
    for make in (training_pool, lambda segments: held_out_pool(segments, NOTHING)):
        with pytest.raises(ValueError, match=rf"at least 3 starts, .* got {starts}; collect more"):
            make(segments)


def test_without_starts_every_pair_may_be_asked_and_then_no_more(generator):
    segments = TensorDict({"observation": torch.zeros(5, 2, 1)}, [5, 2])
    asked = training_pool(segments).draw(300, generator=generator)
    assert len(unordered(asked)) == 10
    pairs = held_out_pool(segments, asked[:6]).draw(300, generator=generator)
    assert not unordered(pairs) & unordered(asked[:6])
