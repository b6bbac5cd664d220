import pytest
import torch

from popl_rl.evaluation.chosen_questions import CHOICE, ask_new_raters, chosen_answers
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.scoring import segment_scores

FIRST, SECOND, TIE, SKIP = range(4)


def test_questions_follow_from_answers():
    """Three hypotheses, and pairs that tell 0 from 1 and 2, 1 from the others, and nobody.

    First, pair 0 or 1 tells one from two: the same gain, so the first is asked. The answer leaves 1
    and 2, which pair 1 tells apart. Pair 2, on which all agree, comes last.
    """
    margin = torch.tensor([[9.0, 9.0, 9.0], [-9.0, -9.0, 9.0], [-9.0, 9.0, 9.0]])
    pairs = torch.tensor([[0, 1], [2, 3], [4, 5]])
    said = chosen_answers(margin, pairs, torch.tensor([SECOND, FIRST, FIRST]), answers=5)
    assert said["pair"].tolist() == [[0, 1], [2, 3], [4, 5]]
    assert said["answer"].tolist() == [SECOND, FIRST, FIRST]
    # A tie tells nothing and is not counted.
    said = chosen_answers(margin, pairs, torch.tensor([TIE, SKIP, FIRST]), answers=2)
    assert said["pair"].tolist() == [[4, 5]]


@pytest.fixture
def policies(generator):
    return PolicySet(Population.create(PolicySpec(5, 2, True, (8,)), 6, generator=generator))


def ask(policies, groups, bank, segments, **changes):
    utility = torch.stack([group.segment_utility(segments) for group in groups])
    settings = {"raters": 4, "curve": [1, 5], "candidates": 60, "seed": 3, **changes}
    scores = segment_scores(policies.population, bank, alpha=policies.alpha)
    return ask_new_raters(policies, groups, bank, scores, utility, **settings)


def test_members_of_new_raters(policies, groups, bank, segments):
    picks = ask(policies, groups, bank, segments)
    assert set(picks) == {(CHOICE, 1), (CHOICE, 5)}
    assert all(chosen.shape == (2, 4) for chosen in picks.values())
    again = ask(policies, groups, bank, segments, curve=[5])
    assert torch.equal(picks[CHOICE, 5], again[CHOICE, 5])


def test_raters_who_never_decide_are_reported(policies, groups, bank, segments):
    flat = segments.clone()
    flat["info"].apply_(lambda value: value.zero_())
    with pytest.raises(ValueError, match="gave no strict answer to 60 queries"):
        ask(policies, groups, bank, flat)
