"""The mixture of CPL policies that EM fits."""

import math

import pytest
import torch

from popl_rl.algorithms.em import EM
from popl_rl.algorithms.expectation import expect
from popl_rl.algorithms.problem import Problem
from popl_rl.config import EMSettings, Training
from popl_rl.models.policies import PolicySpec
from popl_rl.models.preference_likelihood import log_likelihood, per_case
from popl_rl.models.scoring import case_values, margins

SPEC = PolicySpec(5, 2, True, (6,))


def build(bank, comparisons, *, seed=0, members=4, groups=2, generations=4, **recipe):
    training = Training(**{"steps": 12, "batch_size": 16, "slip": 0.0, **recipe})
    problem = Problem(SPEC, bank, comparisons, training, members=members, generations=generations)
    generator = torch.Generator().manual_seed(seed)
    return EM(problem, em=EMSettings(groups=groups), generator=generator)


def given_margins(monkeypatch, margin):
    """Have everybody score preferred segments so, and all others 0."""
    scores = torch.cat([margin, torch.zeros_like(margin)], 1)
    monkeypatch.setattr(Problem, "compared_scores", lambda *_: scores)


def tensors(popl):
    return [
        popl.share,
        *(value.clone() for value in popl.population.members.data.values(True, True)),
    ]


def two_raters(comparisons):
    """Three answers: two of the first rater, one of the second."""
    row = torch.arange(3)
    return type(comparisons)(row, row + 3, torch.tensor([0, 0, 1]), 2)


#: Margins under which two policies give the three answers with these chances.
CHANCES = torch.tensor([[0.8, 0.5, 0.3], [0.4, 0.5, 0.9]])


def test_a_raters_likelihood_is_the_product_over_its_answers(comparisons):
    """0.8 * 0.5 = 0.4 and 0.4 * 0.5 = 0.2; the second rater's one answer has 0.3 and 0.9."""
    likelihood = per_case(log_likelihood(CHANCES.logit(), 0.0), two_raters(comparisons))
    torch.testing.assert_close(likelihood.exp(), torch.tensor([[0.4, 0.3], [0.2, 0.9]]))


def test_responsibilities_by_hand():
    """With shares 3/4 and 1/4: 0.3 against 0.05 is 6/7, and 0.225 against 0.225 is a half."""
    likelihood = torch.tensor([[[0.4, 0.3], [0.2, 0.9]]])
    found = expect(likelihood.log(), torch.tensor([[0.75, 0.25]]))
    expected = torch.tensor([[[6 / 7, 0.5], [1 / 7, 0.5]]])
    torch.testing.assert_close(found.responsibility, expected)
    torch.testing.assert_close(found.evidence.exp(), torch.tensor([[0.35, 0.45]]))


def test_components_out_of_use_have_no_part():
    """The second component explains all better, but is not there."""
    likelihood = torch.tensor([[[0.2], [0.9]]]).log()
    active = torch.tensor([[True, False]])
    found = expect(likelihood, torch.tensor([[1.0, 0.0]]), active=active)
    assert found.responsibility.tolist() == [[[1.0], [0.0]]]
    torch.testing.assert_close(found.evidence.exp(), torch.tensor([[0.2]]))


def test_a_generation_by_hand(monkeypatch, bank, comparisons):
    """Both mixtures have shares of a half.

    The first is as above: responsibilities 0.4 / 0.6 and 0.3 / 1.2, shares 11/24 and 13/24, and
    log-likelihoods log 0.3 and log 0.6. The second, of equals, divides everything by half and is
    less likely, 0.01 and 0.1.
    """
    said = two_raters(comparisons)
    popl = build(bank, said)
    equal = torch.full((2, 3), 0.1)
    margin = torch.cat([CHANCES, equal]).logit()
    given_margins(monkeypatch, margin)
    given = []

    def trained(parents, draws):
        given.append((parents, draws))
        return {}

    monkeypatch.setattr("popl_rl.algorithms.em.by_case", lambda _, weight: weight)
    monkeypatch.setattr(popl.training, "descend", trained)
    metrics = popl.step()
    ((parents, weight),) = given
    assert parents.tolist() == [0, 1, 2, 3], "all stay themselves"
    expected = [[2 / 3, 1 / 4], [1 / 3, 3 / 4], [0.5] * 2, [0.5] * 2]
    torch.testing.assert_close(weight, torch.tensor(expected))
    torch.testing.assert_close(popl.share, torch.tensor([[11 / 24, 13 / 24], [0.5, 0.5]]))
    assert metrics["log_likelihood"] == pytest.approx((math.log(0.3) + math.log(0.6)) / 2)
    assert metrics["smallest_share"] == pytest.approx(11 / 24)


def test_a_component_without_a_share_may_come_back(monkeypatch, bank, comparisons):
    """What a thousandth of a share explains far better than the rest is given back to it."""
    popl = build(bank, two_raters(comparisons), members=2)
    popl.share = torch.tensor([[1.0, 0.0]])
    margin = torch.tensor([[-20.0] * 3, [5.0] * 3])
    given_margins(monkeypatch, margin)
    popl.step()
    assert popl.share[0, 1] > 0.99


@pytest.mark.parametrize(
    ("members", "told", "shape"), [(32, 2, (16, 2)), (32, 3, (10, 3)), (2, 5, (1, 5))]
)
def test_as_many_starts_as_there_is_room_for(bank, comparisons, members, told, shape):
    popl = build(bank, comparisons, members=members, groups=told)
    assert isinstance(popl, EM)
    assert tuple(popl.share.shape) == shape
    assert len(popl.population) == shape[0] * shape[1]
    assert len(popl.result()) == told


@pytest.mark.parametrize("told", [None, 0])
def test_the_number_of_groups_must_be_told(bank, comparisons, told):
    with pytest.raises(ValueError, match=r"em\.groups must be a number of at least 1, got"):
        build(bank, comparisons, groups=told)


def test_slips_soften_what_one_answer_says(monkeypatch, bank, comparisons):
    """Odds of 0.99 against 0.01 become 0.95 0.99 + 0.05 0.01 = 0.941 against 0.059."""
    one = type(comparisons)(torch.tensor([0]), torch.tensor([1]), torch.tensor([0]), 1)
    popl = build(bank, one, members=2, slip=0.05)
    given_margins(monkeypatch, torch.tensor([[0.99], [0.01]]).logit())
    popl.step()
    torch.testing.assert_close(popl.share, torch.tensor([[0.941, 0.059]]))


def test_the_likeliest_start_is_the_result(monkeypatch, bank, comparisons):
    popl = build(bank, comparisons)
    monkeypatch.setattr(popl, "likelihood", lambda: torch.tensor([-2.0, -1.0]))
    found = popl.result()
    assert found.origin == [2, 3]
    members = popl.population.members.data
    kept = found.population.members.data
    assert all(torch.equal(kept[key], members[key][2:]) for key in kept.keys(True, True))


def test_two_obvious_groups_are_found(bank, comparisons):
    """Four raters want to be left and four right; each component ends with one group."""
    popl = build(
        bank,
        comparisons,
        members=8,
        generations=12,
        steps=180,
        learning_rate=0.02,
        alpha=0.5,
        conservatism=0.9,
    )
    metrics = [popl.step() for _ in range(12)]
    found = popl.result()
    values = case_values(
        margins(found.population, bank, comparisons, alpha=found.alpha) > 0, comparisons
    )
    left, right = values[:, :4].mean(1), values[:, 4:].mean(1)
    assert left.argmax() != right.argmax()
    assert float(left.max()) > 0.85
    assert float(right.max()) > 0.85
    assert metrics[-1]["log_likelihood"] > metrics[0]["log_likelihood"]
    assert metrics[-1]["smallest_share"] == pytest.approx(0.5, abs=0.05)
