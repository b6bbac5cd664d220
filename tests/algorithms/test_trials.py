"""Numbers of niches are tried out by fresh members, who are judged by people not learnt of."""

from dataclasses import replace

import pytest
import torch

from popl_rl.algorithms.agreement import Agreement
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.trials import Fold, trials
from popl_rl.config import Training
from popl_rl.models.reward_functions import RewardSpec

SPEC = RewardSpec(1, 1, (16,))


class Divided(Agreement):
    """An agreement upon known niches, which looks as good as its value says."""

    def __new__(cls, niche, looks):
        raters = len(niche)
        agreed = super().__new__(cls, [], torch.full((raters,), looks), int(niche.max()) + 1)
        agreed.niche = niche
        return agreed

    def served(self, _problem):
        return torch.nn.functional.one_hot(self.niche).T.float()


@pytest.fixture
def world(ring):
    """Four groups of nine raters each, and folds that leave out a ninth of them each."""
    bank, comparisons, group = ring(4, raters=9, answers=24)
    training = Training(slip=0.05, conservatism=1.0, learning_rate=0.05, batch_size=64, steps=100)
    problem = Problem(SPEC, bank, comparisons, training, generations=10)

    def only(rows):
        return replace(problem, comparisons=comparisons.rows(rows.nonzero()[:, 0]))

    out = [comparisons.case % 9 == fold for fold in range(2)]
    return problem, [Fold(only(~aside), only(aside)) for aside in out], group


def numbers(group, looks):
    """One niche to four, and six of which two are halves of groups."""
    halves = torch.where(torch.arange(len(group)) % 2 > 0, group + 4, group)
    halves = torch.where(halves > 5, halves - 4, halves)
    niches = [group * 0, group // 2, group.clamp(max=2), group, halves]
    return [Divided(niche, look) for niche, look in zip(niches, looks, strict=True)]


def run(world, looks, *, generations=10, seed=0):
    problem, folds, group = world
    generator = torch.Generator().manual_seed(seed)
    agreed = numbers(group, looks)
    return trials(problem, folds, agreed, generations=generations, generator=generator)


def test_from_a_number_that_looks_best_to_the_one_that_is_best(world):
    """Two look best: they and their neighbours are tried, and then the larger that do better."""
    found = run(world, [-0.9, -0.1, -0.9, -0.9, -0.9])
    mean = {index: float(trial.value.mean()) for index, trial in found.items()}
    assert sorted(mean) == [0, 1, 2, 3, 4]
    assert max(mean, key=lambda index: mean[index]) == 3
    assert mean[3] > mean[2] > mean[1] > mean[0]
    assert all(trial.scale > 0 for trial in found.values())
    # Raters are predicted in the fold that has not learnt of them, here two ninths of all.
    aside = torch.arange(36) % 9 < 2
    assert all(torch.equal(trial.value < 0, aside) for trial in found.values())


def test_far_from_the_best_nothing_is_tried(world):
    assert sorted(run(world, [-0.9, -0.9, -0.9, -0.1, -0.9])) == [2, 3, 4]


def test_members_learn_of_others_than_those_who_judge_them(world):
    """A ninth turn their answers round: members that learn of them alone predict others badly."""
    problem, (fold, *_), group = world
    answers = fold.judged.comparisons
    turned = replace(answers, preferred=answers.other, other=answers.preferred)
    against = fold._replace(judged=replace(fold.judged, comparisons=turned))
    looks = [-0.9, -0.9, -0.9, -0.1, -0.9]
    asked = answers.sizes() > 0
    value = run((problem, [fold], group), looks)[3].value
    assert (value[~asked] == 0).all()
    assert (value[asked] < 0).all()
    known = run((problem, [fold._replace(learnt=against.judged)], group), looks)[3].value
    assert float(known[asked].mean()) < float(value[asked].mean()) - 0.05


def test_same_seed_same_trials(world):
    looks = [-0.1, -0.9, -0.9, -0.9, -0.9]
    first, again = (run(world, looks, generations=2) for _ in range(2))
    assert all(torch.equal(first[index].value, again[index].value) for index in first)
    other = run(world, looks, generations=2, seed=1)
    assert not torch.equal(first[1].value, other[1].value)
