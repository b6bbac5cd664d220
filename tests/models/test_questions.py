import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from popl_rl.data.comparisons import Comparisons
from popl_rl.keys import Answer
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.questions import (
    RULES,
    Behaviours,
    best_question,
    chance_of_first,
    expected_maximum,
    information_gain,
    volume_removal,
)

HALF = torch.tensor([0.5, 0.5])


def said(pairs, replies):
    return TensorDict({"pair": torch.tensor(pairs), "answer": torch.tensor(replies)}, [len(pairs)])


def test_rules_by_hand():
    """Two hypotheses believed alike, three pairs.

    Pair 0: they are sure of opposite answers, H(1/2) - 0 = 1 bit. Pair 1: both throw a coin,
    1 - 1 = 0 bits; volume removal likes it as much as pair 0. Pair 2: one is sure of the first, the
    other throws a coin: H(3/4) - H(1/2) / 2 = 0.8113 - 0.5 bits; the rarer answer has 1/4; after
    "first" (3/4) the favourite has 0.5 of it, after "second" (1/4) all: 0.5 + 0.25.
    """
    chance = torch.tensor([[1.0, 0.5, 1.0], [0.0, 0.5, 0.5]])
    gained = information_gain(chance, HALF)
    torch.testing.assert_close(gained, torch.tensor([1.0, 0.0, 0.8112781 - 0.5]))
    torch.testing.assert_close(volume_removal(chance, HALF), torch.tensor([0.5, 0.5, 0.25]))
    torch.testing.assert_close(expected_maximum(chance, HALF), torch.tensor([1.0, 0.5, 0.75]))


def test_slips_bound_what_an_answer_can_tell():
    """With one slip in ten an answer about sure opposites tells 1 - H(0.1) bits."""
    chance = chance_of_first(torch.tensor([[100.0], [-100.0]]), 0.1)
    expected = 1 + 0.1 * math.log2(0.1) + 0.9 * math.log2(0.9)
    assert float(information_gain(chance, HALF)) == pytest.approx(expected, abs=1e-5)


chances = st.lists(
    st.lists(st.floats(0, 1, width=32), min_size=3, max_size=3), min_size=2, max_size=5
)


@given(chances, st.integers(0, 2**16))
@settings(max_examples=60, deadline=None)
def test_what_a_question_tells_is_bounded_and_symmetric(rows, seed):
    chance = torch.tensor(rows, dtype=torch.double)
    belief = torch.rand(len(rows), generator=torch.Generator().manual_seed(seed)).double() + 1e-3
    belief /= belief.sum()
    gained = information_gain(chance, belief)
    known = -(belief * belief.log2()).sum()
    assert (gained >= -1e-9).all()
    assert (gained <= min(1.0, float(known)) + 1e-9).all()
    for rule in RULES.values():  # left and right do not matter
        torch.testing.assert_close(rule(chance, belief), rule(1 - chance, belief))
    most = expected_maximum(chance, belief)  # an answer never makes the guess worse
    assert (most >= belief.max() - 1e-9).all()


def test_equal_behaviours_count_as_one():
    """Hypotheses 0 and 1 rank every candidate alike, 2 and 3 are their opposites on pair 0."""
    margin = torch.tensor([[9.0, 1.0], [2.0, 9.0], [-9.0, 1.0], [-2.0, 4.0]])
    behaviours = Behaviours(margin, mistake=0.0)
    assert len(behaviours) == 2
    assert behaviours.label.tolist() == [0, 0, 1, 1]
    weights = torch.tensor([0.1, 0.3, 0.4, 0.2])
    torch.testing.assert_close(behaviours.belief(weights), torch.tensor([0.4, 0.6]))
    # Pair 1 tells 0 and 1 apart by their firmness only, which nobody needs to know.
    by_hand = (
        (weights[:2] @ behaviours.chance[:2]) / 0.4,
        (weights[2:] @ behaviours.chance[2:]) / 0.6,
    )
    expected = information_gain(torch.stack(by_hand), torch.tensor([0.4, 0.6]))
    torch.testing.assert_close(behaviours.values(weights, "information_gain"), expected)
    assert best_question(behaviours, weights, torch.tensor([True, True]))[0] == 0
    assert best_question(behaviours, weights, torch.tensor([False, True]))[0] == 1


def test_uniform_questions_are_uniform(generator):
    behaviours = Behaviours(torch.randn(3, 4, generator=generator))
    may = torch.tensor([True, False, True, True])
    drawn = [
        best_question(
            behaviours, torch.full((3,), 1 / 3), may, rule="uniform", generator=generator
        )[0]
        for _ in range(600)
    ]
    counts = torch.tensor(drawn).bincount(minlength=4)
    assert counts[1] == 0
    assert (counts[[0, 2, 3]] > 150).all()


@pytest.fixture
def policies(bank, generator):
    return PolicySet(Population.create(PolicySpec(5, 2, True, (8,)), 5, generator=generator))


def test_the_next_question_is_the_best_of_the_candidates(policies, segments, bank):
    pairs = torch.tensor([[0, 1], [2, 3], [4, 5], [6, 7], [8, 9]])
    so_far = said([[2, 3]], [1])
    asked = policies.next_question(segments, so_far, pairs=pairs, enough=2.0)
    comparisons = Comparisons.from_preferences(said(pairs.tolist(), [0] * 5), cases="preference")
    behaviours = Behaviours(policies.margins(bank, comparisons))
    weights = policies.cater(segments, so_far).weights
    torch.testing.assert_close(asked.weights, weights)
    values = behaviours.values(weights, "information_gain")
    values[1] = -1
    assert asked.pair.tolist() == pairs[int(values.argmax())].tolist()
    assert asked.value == pytest.approx(float(values.max()))


@pytest.mark.parametrize("rule", [*RULES, "uniform"])
def test_no_pair_is_asked_twice_in_either_order(policies, segments, rule, generator):
    pairs = torch.tensor([[0, 1], [2, 3], [4, 5], [1, 0]])
    so_far, asked = None, []
    while True:
        question = policies.next_question(
            segments, so_far, rule=rule, pairs=pairs, enough=2.0, generator=generator
        )
        if question is None:
            break
        asked.append(sorted(question.pair.tolist()))
        # Also what was skipped is not asked again.
        so_far = said(asked, [int(Answer.SKIP)] * len(asked))
    assert sorted(asked) == [[0, 1], [2, 3], [4, 5]]


def test_asking_ends(policies, segments, generator):
    answers = said([[0, 1], [2, 3]], [0, 1])
    ask = {"generator": generator, "candidates": 50}
    assert policies.next_question(segments, answers, limit=2, **ask) is None
    assert policies.next_question(segments, answers, limit=3, enough=2.0, **ask) is not None
    most = float(policies.cater(segments, answers).weights.max())
    assert policies.next_question(segments, answers, enough=most, **ask) is None
    # Two equal policies: nothing that could be asked would matter.
    twins = policies.subset([1, 1])
    assert twins.next_question(segments, generator=generator) is None


def test_only_segments_from_one_start_are_compared(policies, segments, generator):
    start = (torch.arange(len(segments)) // 4).unsqueeze(1).expand(segments.shape)
    segments["info", "start"] = start
    for _ in range(20):
        question = policies.next_question(
            segments, rule="uniform", enough=2.0, candidates=5, generator=generator
        )
        first, second = question.pair.tolist()
        assert first != second
        assert first // 4 == second // 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rule": "guess"}, "rule must be uniform, information_gain, .*, got 'guess'"),
        ({"candidates": 0}, "candidates must be at least 1, got 0"),
        ({}, "generator must be given to draw candidates"),
        ({"pairs": torch.zeros(0, 2)}, r"pairs must have shape \[P, 2\] with P > 0, got \[0, 2\]"),
        ({"mistake": 0.5, "pairs": torch.tensor([[0, 1]])}, r"mistake must be in \[0, 0.5\)"),
    ],
)
def test_wrong_arguments_are_refused(policies, segments, arguments, message):
    with pytest.raises(ValueError, match=message):
        policies.next_question(segments, **arguments)


def test_choosing_finds_the_member_sooner(generator):
    """Ten random rankings of 60 segments: after 5 answers, right far more often than by chance."""
    scores = 4 * torch.randn(10, 60, generator=generator)
    right = dict.fromkeys(("uniform", "information_gain"), 0)
    for rule in right:
        for trial in range(40):
            pairs = torch.randint(60, (300, 2), generator=generator)
            behaviours = Behaviours(scores[:, pairs[:, 0]] - scores[:, pairs[:, 1]])
            log_weight, may = torch.zeros(10), torch.ones(300, dtype=torch.bool)
            for _ in range(5):
                index, _ = best_question(
                    behaviours, log_weight.softmax(0), may, rule=rule, generator=generator
                )
                may[index] = False
                first = torch.rand((), generator=generator) < behaviours.chance[trial % 10, index]
                chance = behaviours.chance[:, index]
                log_weight += torch.log(chance if first else 1 - chance)
            right[rule] += int(log_weight.argmax()) == trial % 10
    assert right["information_gain"] >= right["uniform"] + 6
