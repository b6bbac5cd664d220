"""Raters are clustered first, then each cluster has a hypothesis."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.cpl import train
from popl_rl.algorithms.kmeans import KMeans, cluster_raters
from popl_rl.config import KMeansSettings, POPLSettings, Training
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.scoring import case_values


def build(problem, **settings):
    return KMeans(
        problem,
        kmeans=KMeansSettings(**settings),
        popl=POPLSettings(specialist_steps=30, pooled_steps=30),
        generator=torch.Generator().manual_seed(0),
    )


def three_kinds():
    """Six raters of each of three kinds, whose answers nine specialists explain; some noise."""
    centre = torch.eye(3).repeat_interleave(3, 0).repeat_interleave(6, 1)
    noise = torch.randn(centre.shape, generator=torch.Generator().manual_seed(0))
    return 0.5 + 0.3 * centre + 0.03 * noise


@pytest.mark.parametrize("groups", [3, None])
def test_clusters_are_the_kinds_of_raters(groups):
    found = cluster_raters(three_kinds(), groups=groups, most=6, seed=0)
    assert len(found.unique()) == 3
    assert [len(part.unique()) for part in found.view(3, 6)] == [1, 1, 1]


def test_raters_whom_nothing_tells_apart_are_one_cluster():
    assert cluster_raters(torch.ones(4, 5), groups=2, most=6, seed=0).unique().tolist() == [0]
    assert cluster_raters(torch.ones(4, 5), groups=None, most=6, seed=0).tolist() == [0] * 5


def test_each_group_has_a_hypothesis(problem):
    training = Training(steps=200, batch_size=64, learning_rate=0.01)
    method = build(replace(problem, training=training), groups=2)
    assert method.cluster[:4].unique().numel() == method.cluster[4:].unique().numel() == 1
    found = train(method)
    assert len(found) == 2
    values = case_values(problem.margins(found.population) > 0, problem.comparisons)
    own = values[method.cluster, torch.arange(8)]
    assert own.min() > 0.7


def test_what_it_cannot_learn_from_is_refused(problem, comparisons):
    count = len(comparisons)
    alone = Comparisons(comparisons.preferred, comparisons.other, torch.arange(count), count)
    with pytest.raises(ValueError, match="method kmeans needs rater ids"):
        build(replace(problem, comparisons=alone), groups=2)
    with pytest.raises(ValueError, match=r"kmeans\.groups must be a number of at least 1"):
        build(problem)
    with pytest.raises(ValueError, match="needs 9 raters or more, got 8"):
        build(problem, groups=9)
    with pytest.raises(ValueError, match=r"method\.evolve must be all for method kmeans"):
        build(replace(problem, evolve="head"), groups=2)
