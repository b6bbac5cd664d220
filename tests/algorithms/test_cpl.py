import pytest
import torch

from popl_rl.algorithms.cpl import GroupCPL, group_weights, pooled_population, train
from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.evaluation.measures import group_accuracy, held_out_pairs
from popl_rl.models.policies import PolicySpec
from popl_rl.models.scoring import segment_scores

SPEC = PolicySpec(5, 2, True, (8,))


def parameters_of(policies):
    return list(policies.population.members.data.values(True, True))


@pytest.fixture
def weight(preferences):
    strict = preferences["answer"] <= 1
    return group_weights(preferences["hidden", "group"][strict], 2)


def test_weights_by_hand():
    """The pooled policy sees all four comparisons, each oracle those of its own group."""
    weight = group_weights(torch.tensor([0, 2, 1, 0]), 3)
    assert weight.tolist() == [[1, 1, 1, 1], [1, 0, 0, 1], [0, 0, 1, 0], [0, 1, 0, 0]]


def test_a_group_without_a_word_is_refused():
    message = r"groups \[1, 3\] have no strict answer, so no oracle can be trained for them"
    with pytest.raises(ValueError, match=message):
        group_weights(torch.tensor([0, 2, 0]), 4)


def test_oracles_learn_what_their_groups_want(
    bank, comparisons, weight, groups, segments, generator
):
    training = Training(
        steps=150, batch_size=32, learning_rate=1e-2, alpha=0.3, discount=0.99, slip=0.0
    )
    problem = Problem(SPEC, bank, comparisons, training, generations=3)
    policies = train(GroupCPL(problem, weight=weight, generator=generator))
    assert (len(policies), policies.alpha, policies.discount) == (3, 0.3, 0.99)
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    pairs = {g: held_out_pairs(segment_utility, g, count=500, generator=generator) for g in (0, 1)}
    accuracy = group_accuracy(segment_scores(policies.population, bank), pairs)
    assert bool((accuracy[1:].diagonal() > 0.75).all()), accuracy
    # The groups want the opposite, so that pooling them serves neither.
    assert float(accuracy[0].min()) < 0.65


def short(bank, comparisons, *, steps=3, generations=3):
    training = Training(steps=steps, batch_size=4)
    return Problem(SPEC, bank, comparisons, training, generations=generations)


def test_the_seed_decides_everything(bank, comparisons, weight):
    def run(seed):
        generator = torch.Generator().manual_seed(seed)
        problem = short(bank, comparisons)
        return parameters_of(train(GroupCPL(problem, weight=weight, generator=generator)))

    assert all(map(torch.equal, run(0), run(0)))
    assert not any(map(torch.equal, run(0), run(1)))


def test_nobody_has_to_watch(bank, comparisons, weight, monkeypatch):
    """Without a look at how well it goes hypotheses come out the same, and nothing is scored."""

    def trained(*, watched):
        method = GroupCPL(
            Problem(SPEC, bank, comparisons, Training(steps=6, batch_size=8), generations=3),
            weight=weight,
            generator=torch.Generator().manual_seed(0),
        )
        if watched:
            while method.generation < method.generations:
                assert method.step()["worst_rater_accuracy"] >= 0
        else:
            monkeypatch.setattr(Problem, "compared_scores", None)
            train(method)
        return parameters_of(method)

    assert all(map(torch.equal, trained(watched=True), trained(watched=False)))


def test_progress_is_told_by_generations(bank, comparisons, weight, generator):
    seen = []
    method = GroupCPL(short(bank, comparisons), weight=weight, generator=generator)
    train(method, progress=seen.append)
    assert seen == [1, 2, 3]
    assert train(method) is not None, "what is finished has a result"
    assert method.generation == 3


def test_weights_say_who_learns_from_what(bank, comparisons, generator):
    """Two that draw the same single comparison end where two with all comparisons do not."""
    only = torch.zeros(2, len(comparisons))
    only[:, 0] = 1.0
    problem = short(bank, comparisons, steps=60)
    found = train(GroupCPL(problem, weight=only, generator=generator))
    scores = segment_scores(found.population, bank)
    first = comparisons.rows(torch.tensor([0]))
    assert bool((scores[:, first.preferred] > scores[:, first.other]).all())


def test_a_pooled_hypothesis_takes_steps_of_its_own(bank, comparisons, generator):
    problem = short(bank, comparisons, steps=1)
    pooled = pooled_population(problem, steps=40, generator=generator)
    assert len(pooled) == 1
    margin = problem.margins(pooled)
    assert float((margin > 0).float().mean()) > 0.4
