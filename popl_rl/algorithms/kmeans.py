"""Raters are clustered first, by specialists; then a CPL hypothesis is trained for each cluster.

Two stages instead of one: what a rater wants is read off how well specialists for some raters
explain its answers, k-means divides the raters, once and for all, and every cluster is given a
hypothesis of its own, trained on its raters' answers by the recipe of all (Bradley–Terry where
hypotheses are reward functions).
"""

import importlib.util
import warnings

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from torch import Tensor

from popl_rl.algorithms.cpl import GroupCPL
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.specialists import train_specialists
from popl_rl.config import KMeansSettings, POPLSettings
from popl_rl.models.hypothesis_set import HypothesisSet

__all__ = ["KMeans", "cluster_raters"]

_SPECIALISTS = 256  # more tell no more
_MOST_SILHOUETTE = 2000  # raters whom a silhouette is taken over: it compares each with each
_STARTS = 10


def cluster_raters(values: Tensor, *, groups: int | None, most: int, seed: int) -> Tensor:
    """Divide raters by which specialists explain their answers better than others do.

    A rater's profile is its row of values less their mean, scaled to length 1, so that the squared
    distance of two is twice their correlation below 1, and a rater who contradicts itself is not
    far from everybody.

    Args:
        values: Share of each rater's answers that a specialist ranks right, ``[S, C]``.
        groups: Number of clusters; None for the one of the largest mean silhouette (Rousseeuw,
            1987) from 2 to ``most``.
        most: Most clusters to choose among.
        seed: Seed of the starts, and of the raters whom a silhouette is taken over.

    Returns:
        Cluster of each rater, ``[C]`` int64, numbered from 0; each has a rater.

    Raises:
        ValueError: If scikit-learn is missing, or there are fewer raters than clusters.
    """
    if importlib.util.find_spec("sklearn") is None:
        raise ValueError(
            "method kmeans needs the package scikit-learn, which is not installed: "
            "pip install 'popl_rl[benchmark]'"
        )
    from sklearn.cluster import KMeans as Clusters

    profile = values.T - values.T.mean(1, keepdim=True)
    points = F.normalize(profile, dim=1).cpu().double().numpy()
    if len(points) < (groups or 3):
        raise ValueError(f"method kmeans needs {groups or 3} raters or more, got {len(points)}")
    counts = [groups] if groups is not None else range(2, min(most, len(points) - 1) + 1)
    with warnings.catch_warnings():
        # Raters whom all specialists explain alike are in one place; clusters are numbered below.
        warnings.filterwarnings("ignore", message="Number of distinct clusters")
        each = [Clusters(k, n_init=_STARTS, random_state=seed).fit_predict(points) for k in counts]
    best = max(each, key=lambda label: _silhouette(points, label, seed)) if each[1:] else each[0]
    return torch.from_numpy(np.unique(best, return_inverse=True)[1]).long()


def _silhouette(points: npt.NDArray[np.float64], label: npt.NDArray[np.int32], seed: int) -> float:
    """Mean silhouette of some raters; -1, the least there is, of a single cluster."""
    from sklearn.metrics import silhouette_score

    if len(np.unique(label)) < 2:
        return -1.0
    size = min(len(points), _MOST_SILHOUETTE)
    return float(silhouette_score(points, label, sample_size=size, random_state=seed))


class KMeans(GroupCPL):
    """A hypothesis for each cluster of raters.

    Args:
        problem: What is to be learnt.
        kmeans: Number of clusters, or who chooses it.
        popl: Steps of the specialists.
        generator: Source of all randomness.

    Attributes:
        cluster: Cluster of each rater, ``[C]``.

    Raises:
        ValueError: If the number of clusters is missing, every case is one preference, members
            are heads or style codes, or scikit-learn is missing.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        kmeans: KMeansSettings,
        popl: POPLSettings,
        generator: torch.Generator,
    ) -> None:
        if kmeans.groups is None and not kmeans.silhouette:
            raise ValueError("kmeans.groups must be a number of at least 1, got None")
        if problem.comparisons.is_single:
            raise ValueError(
                "method kmeans needs rater ids, because it clusters raters; use "
                "method.cases=rater with several answers of each"
            )
        if problem.clone is not None or problem.evolve != "all":
            raise ValueError("method.evolve must be all for method kmeans")
        found = train_specialists(problem, popl, most=_SPECIALISTS, generator=generator)
        seed = int(torch.randint(2**31, (), generator=generator, device=generator.device))
        cluster = cluster_raters(found.values, groups=kmeans.groups, most=kmeans.most, seed=seed)
        self.cluster = cluster.to(problem.device)
        own = F.one_hot(self.cluster).T.float()
        weight = own[:, problem.comparisons.case]
        super().__init__(problem, weight=weight, generator=generator)

    def result(self) -> HypothesisSet:
        """The clusters' hypotheses, their scale fitted for catering."""
        return self.problem.calibrated(super().result())
