import math

import torch

from popl_rl.evaluation.best_of_set import best_of_set, coverage, lowest, to_roll


def test_each_member_is_rolled_once_and_points_are_taken_in_whole():
    """Three members must be rolled. Ten answers need one more, and then all five places but one are
    taken: two answers, with two more, do not fit, but one answer does, with one."""
    always = [torch.tensor([[3, 1], [3, 3]]), torch.tensor(7)]
    points = {
        ("posterior", 1): torch.tensor([9, 1]),
        ("posterior", 2): torch.tensor([4, 5]),
        ("posterior", 10): torch.tensor([2, 3]),
    }
    assert to_roll(always, points, limit=5) == [1, 2, 3, 7, 9]
    assert to_roll(always, points, limit=1) == [1, 3, 7], "these always"
    assert to_roll(always, points, limit=99) == [1, 2, 3, 4, 5, 7, 9]


def test_the_best_in_hindsight_by_hand():
    """Group 0: policy 0 is best on the first half and worth 2 on the other; policy 1 the other way
    round, and worth 1: 1.5, though each reached 5 somewhere. Group 1: policy 1 both ways."""
    first = torch.tensor([[5.0, 0.0], [1.0, 4.0]])
    second = torch.tensor([[2.0, 0.0], [5.0, 6.0]])
    assert best_of_set(first, second).tolist() == [1.5, 5.0]


def test_the_best_of_equals_is_no_better(generator):
    """Means of 64 equal policies: their highest is above 2, the best in hindsight about 0."""
    first, second = torch.randn(2, 64, 200, generator=generator)
    assert float(first.amax(0).mean()) > 2
    assert abs(float(best_of_set(first, second).mean())) < 0.2


def test_coverage_and_the_lowest_by_hand():
    assert coverage([0.9, 1.2, 0.89, -1.0]) == 0.5
    assert coverage([1.0]) == 1
    assert lowest([0.9, -0.2]) == -0.2
    for unknown in ([1.0, math.nan], [math.nan, 1.0]):
        assert math.isnan(coverage(unknown))
        assert math.isnan(lowest(unknown))
