import pytest
import torch

from popl_rl.algorithms.cpl import group_weights, train_cpl
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
    policies = train_cpl(
        SPEC,
        bank,
        comparisons,
        weight,
        steps=150,
        batch_size=32,
        learning_rate=1e-2,
        alpha=0.3,
        discount=0.99,
        generator=generator,
    )
    assert (len(policies), policies.alpha, policies.discount) == (3, 0.3, 0.99)
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    pairs = {g: held_out_pairs(segment_utility, g, count=500, generator=generator) for g in (0, 1)}
    accuracy = group_accuracy(segment_scores(policies.population, bank), pairs)
    assert bool((accuracy[1:].diagonal() > 0.75).all()), accuracy
    # The groups want the opposite, so that pooling them serves neither.
    assert float(accuracy[0].min()) < 0.65


def test_the_seed_decides_everything(bank, comparisons, weight):
    def train(seed):
        generator = torch.Generator().manual_seed(seed)
        return parameters_of(
            train_cpl(SPEC, bank, comparisons, weight, steps=3, batch_size=4, generator=generator)
        )

    assert all(map(torch.equal, train(0), train(0)))
    assert not any(map(torch.equal, train(0), train(1)))


@pytest.mark.parametrize(("steps", "told"), [(1, [1]), (50, [50]), (120, [50, 100, 120])])
def test_progress_is_told(bank, comparisons, weight, generator, steps, told):
    seen = []
    train_cpl(
        SPEC,
        bank,
        comparisons,
        weight,
        steps=steps,
        batch_size=1,
        generator=generator,
        progress=seen.append,
    )
    assert seen == told
