import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows

from popl_rl.algorithms.losses import CPLLoss
from popl_rl.algorithms.rater_similarity import rater_similarity, seed_with_specialists
from popl_rl.algorithms.specialists import specialists
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.scoring import case_values, margins


@pytest.fixture
def population(generator):
    return Population.create(PolicySpec(5, 2, True, (16,)), 3, generator=generator)


@pytest.fixture
def loss(population, bank):
    return CPLLoss(population, bank)


def correlations(margin, raters):
    """Of everybody with everybody, told by margins of specialists on one comparison each."""
    similarity = rater_similarity(F.logsigmoid(margin), raters)
    return similarity.rows(torch.arange(len(similarity)))


def test_kinship_by_hand():
    """Four raters with one comparison each; specialists 0 and 1 serve 0 and 1, 2 and 3 the others.

    Margins far from zero make log-likelihoods 0 or minus the margin, so profiles are, but for what
    replaces a rater's own specialist, opposite between the pairs.
    """
    sign = torch.tensor([1.0, 1.0, -1.0, -1.0])
    similarity = correlations(50 * sign.outer(sign), torch.arange(4))
    assert similarity.shape == (4, 4)
    torch.testing.assert_close(similarity.diagonal(), torch.ones(4))
    assert similarity[0, 1] > 0.3
    assert similarity[2, 3] > 0.3
    assert (similarity[:2, 2:] < -0.5).all()
    torch.testing.assert_close(similarity, similarity.T)


def test_a_specialist_says_nothing_about_its_own_rater():
    margin = torch.randn(5, 5, generator=torch.Generator().manual_seed(0))
    changed = margin.clone()
    changed.diagonal().fill_(100.0)
    everybody = torch.arange(5)
    torch.testing.assert_close(
        correlations(margin, everybody),
        correlations(changed, everybody),
    )


def test_specialists_for_some_tell_of_all():
    sign = torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    some = torch.tensor([4, 0, 1])
    similarity = correlations(50 * sign[some].outer(sign), some)
    assert similarity.shape == (6, 6)
    assert similarity[2, 1] > 0.4  # nobody is a specialist for rater 2
    assert similarity[3, 5] > 0.4
    assert similarity[2, 3] < -0.5


def test_a_rater_whom_all_explain_alike_is_nobodys_kin():
    margin = torch.randn(4, 4, generator=torch.Generator().manual_seed(0))
    margin[:, 2] = 1.0
    similarity = correlations(margin, torch.arange(4))
    assert similarity.isfinite().all()
    assert similarity[2].abs().max() < 1e-3


def test_specialists_pass_what_their_raters_said(population, loss, bank, comparisons, generator):
    found = specialists(
        population.subset([0]),
        loss,
        comparisons,
        torch.arange(comparisons.num_cases),
        steps=60,
        learning_rate=0.02,
        generator=generator,
    )
    assert len(found) == comparisons.num_cases
    margin = margins(found, bank, comparisons, alpha=0.5)
    own = case_values(margin > 0, comparisons).diagonal()
    pooled = case_values(margins(population, bank, comparisons) > 0, comparisons)[0]
    assert own.mean() > pooled.mean() + 0.2


def test_groups_are_told_apart(population, loss, comparisons, generator):
    """The first four raters want the opposite of the other four."""
    single = population.subset([0])
    found = seed_with_specialists(population, single, loss, comparisons, generator=generator)
    similarity = found.rows(torch.arange(8))
    same = torch.arange(8).unsqueeze(1) // 4 == torch.arange(8) // 4
    alike = similarity[same & ~torch.eye(8, dtype=torch.bool)]
    assert alike.mean() > 0.3
    assert similarity[~same].mean() < -0.2


def test_the_population_is_overwritten_by_specialists(population, loss, comparisons, generator):
    before = population.members.data.clone()
    single = population.subset([0])
    seed_with_specialists(population, single, loss, comparisons, generator=generator)
    for name, value in population.members.data.items(True, True):
        assert value.isfinite().all()
        assert not torch.equal(value, before[name])
