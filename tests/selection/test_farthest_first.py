"""Farthest-first traversal, worked by hand on a line."""

import torch

from popl_rl.selection.farthest_first import farthest_first

LINE = torch.tensor([0.0, 1.0, 4.0, 0.0, 10.0])


def nearness(some, others):
    return -(LINE[some, None] - LINE[others]).abs()


def test_a_line_by_hand():
    """From 10 the farthest is 0, the first of two; then 4, 1, and the other 0 at last."""
    assert farthest_first(nearness, 5, 3, first=4).tolist() == [4, 0, 2]
    assert farthest_first(nearness, 5, 5, first=4).tolist() == [4, 0, 2, 1, 3]


def test_points_repeat_only_if_they_may():
    assert farthest_first(nearness, 5, 7, first=4, repeat=True).tolist() == [4, 0, 2, 1, 0, 0, 0]


def test_ties_are_broken_by_the_generator_or_by_the_index():
    assert farthest_first(nearness, 5, 1).tolist() == [0]
    seconds = {
        tuple(
            farthest_first(
                nearness, 5, 2, first=4, generator=torch.Generator().manual_seed(seed)
            ).tolist()
        )
        for seed in range(20)
    }
    assert seconds == {(4, 0), (4, 3)}
