"""Which members share a behaviour, against rows compared one by one."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.selection.behaviours import label_behaviours
from popl_rl.selection.lexicase import lexicase_report


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@settings(max_examples=50, deadline=None)
@given(
    members=st.integers(2, 30), cases=st.integers(1, 700), flips=st.integers(0, 6), data=st.data()
)
def test_rows_are_one_behaviour_exactly_if_they_are_equal(members, cases, flips, data):
    seed = data.draw(st.integers(0, 99))
    scores = torch.zeros(members, cases, dtype=torch.bool)
    for _ in range(flips):
        member = data.draw(st.integers(0, members - 1))
        scores[member, data.draw(st.integers(0, cases - 1))] ^= True
    report = lexicase_report(scores, 1, generator=generator(seed))
    assert report.distinct == len(scores.unique(dim=0))


def test_a_single_row_that_is_cut_from_a_wider_one():
    """Its stride is no multiple of a word."""
    scores = torch.zeros(1, 300, dtype=torch.uint8)
    labels, first = label_behaviours(scores)
    assert labels.tolist() == first.tolist() == [0]
