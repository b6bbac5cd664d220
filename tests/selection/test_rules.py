"""Rules of parent selection beside lexicase."""

import pytest
import torch
from scipy.stats import chisquare

from popl_rl.algorithms.assembly import build_popl
from popl_rl.algorithms.problem import Problem
from popl_rl.config import MixtureSettings, POPLSettings, Training
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.scoring import case_values, margins
from popl_rl.selection import rules as selection
from popl_rl.selection.rules import (
    SELECTIONS,
    best_sum_selection,
    fronts_and_crowding,
    nsga2_selection,
    random_selection,
    report,
    selection_rule,
    single_case_selection,
    tournament_selection,
)

# Sums 8, 9, 8 and 5 eighths. The last is dominated by the second alone.
VALUES = torch.tensor([[8, 0], [4, 5], [1, 7], [3, 2]]) / 8


@pytest.fixture(params=SELECTIONS)
def rule(request):
    return SELECTIONS[request.param]


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_a_tournament_of_everybody_picks_the_best_sum(generator):
    assert tournament_selection(VALUES, 20, size=4, generator=generator).tolist() == [1] * 20
    assert tournament_selection(VALUES, 3, size=99, generator=generator).tolist() == [1] * 3


def test_chances_in_a_tournament_of_two(generator):
    """Six pairs: member 1 wins its three, 3 loses its three, 0 and 2 share theirs and one more.

    Member 0 wins against 3 and half the time against 2, which is 1.5 of 6, and so does 2.
    """
    parents = tournament_selection(VALUES, 6000, size=2, generator=generator)
    counts = parents.bincount(minlength=4)
    assert counts[3] == 0
    assert chisquare(counts[:3], [1500, 3000, 1500]).pvalue > 1e-4


def test_a_tournament_of_one_is_no_selection(generator):
    counts = tournament_selection(VALUES, 4000, size=1, generator=generator).bincount()
    assert chisquare(counts).pvalue > 1e-4


def test_the_best_quarter_by_sum(generator):
    assert best_sum_selection(VALUES, 8, generator=generator).tolist() == [1] * 8
    half = best_sum_selection(VALUES, 4000, share=0.5, generator=generator)
    # Of the members with equal sums the first counts as the better one.
    assert set(half.tolist()) == {0, 1}
    assert chisquare(half.bincount()).pvalue > 1e-4
    # A quarter of five members, rounded up, is two of them.
    five = torch.tensor([[1.0], [5.0], [3.0], [4.0], [2.0]])
    assert set(best_sum_selection(five, 50, generator=generator).tolist()) == {1, 3}


def test_the_best_on_a_single_case_by_hand(generator):
    """Case 0 has one best member, 0; on case 1 members 1 and 3 are equally good: 1/2, 1/4, 1/4."""
    values = torch.tensor([[0.9, 0.1], [0.4, 0.8], [0.6, 0.7], [0.1, 0.8]])
    counts = single_case_selection(values, 8000, generator=generator).bincount(minlength=4)
    assert counts[2] == 0, "second on both cases, so never selected"
    assert chisquare(counts[[0, 1, 3]], [4000, 2000, 2000]).pvalue > 1e-4


def test_random_parents_are_uniform(generator):
    counts = random_selection(VALUES, 4000, generator=generator).bincount()
    assert chisquare(counts).pvalue > 1e-4


def test_fronts_and_crowding_on_paper():
    """Members 0, 1 and 2 are better on one case each than any other; 3 is dominated by 1.

    In the first front 0 and 2 are at the ends. On each case the neighbours of member 1 are these
    two, as far apart as the front is wide; pymoo takes the mean over the cases, (1 + 1) / 2.
    """
    front, crowding = fronts_and_crowding(VALUES)
    assert front.tolist() == [0, 0, 0, 1]
    assert crowding[:3].tolist() == [torch.inf, 1.0, torch.inf]


@pytest.mark.parametrize("cases", [3, 255, 256, 600])
def test_fronts_of_any_number_of_cases(generator, cases):
    """Whoever is worse than another nowhere, and better somewhere, is in an earlier front."""
    best = torch.rand(5, cases, generator=generator).round(decimals=1)
    values = torch.cat([best, best - 0.5, best - 1.0])
    front, _ = fronts_and_crowding(values)
    beats = (values.unsqueeze(1) >= values).all(2) & (values.unsqueeze(1) > values).any(2)
    expected = torch.full((15,), -1)
    for number in range(15):
        left = expected < 0
        dominated = (beats & left.unsqueeze(1) & left).any(0)
        expected[left & ~dominated] = number
    assert front.tolist() == expected.tolist()
    assert front.max() >= 2


def test_nsga2_prefers_the_front_and_then_the_edge(generator):
    """Sixteen ordered pairs: 3 wins only against itself, 1 against itself and 3.

    So 3 has 1 of 16, 1 has 1 + 2 = 3, and 0 and 2, equals, share the other 12.
    """
    counts = nsga2_selection(VALUES, 8000, generator=generator).bincount(minlength=4)
    assert chisquare(counts, [3000, 1500, 3000, 500]).pvalue > 1e-4


def test_without_pymoo_nsga2_says_what_to_install(monkeypatch, generator):
    monkeypatch.setattr(selection, "find_spec", lambda _name: None)
    message = r"selection 'nsga2' needs pymoo.*pip install 'popl_rl\[benchmark\]'"
    with pytest.raises(ValueError, match=message):
        nsga2_selection(VALUES, 2, generator=generator)
    with pytest.raises(ValueError, match=message):
        selection_rule("nsga2")
    assert selection_rule("tournament") is not None, "others do without it"


@pytest.mark.parametrize(
    ("values", "count", "error", "message"),
    [
        (torch.zeros(3), 2, ValueError, r"values must be a \[member, case\] matrix"),
        (torch.full((2, 2), torch.nan), 2, ValueError, "values must not contain NaN"),
        (VALUES, 0, ValueError, "num_selected must be at least 1, got 0"),
        (VALUES, 1.5, TypeError, "num_selected must be an int, got float"),
    ],
)
def test_every_rule_refuses_what_makes_no_sense(rule, generator, values, count, error, message):
    with pytest.raises(error, match=message):
        rule(values, count, generator=generator)


def test_sizes_are_checked(generator):
    with pytest.raises(ValueError, match="size must be at least 1, got 0"):
        tournament_selection(VALUES, 2, size=0, generator=generator)
    with pytest.raises(ValueError, match=r"share must be in \(0, 1\], got 0"):
        best_sum_selection(VALUES, 2, share=0, generator=generator)


def test_rules_are_found_by_name():
    assert selection_rule("lexicase") is None
    assert selection_rule("best_sum") is best_sum_selection
    with pytest.raises(ValueError, match=r"selection must be one of lexicase, .*got 'roulette'"):
        selection_rule("roulette")


def test_the_size_of_tournaments_is_passed_on(generator):
    everybody = selection_rule("tournament", tournament=4)
    assert everybody(VALUES, 5, generator=generator).tolist() == [1] * 5


def test_a_report_by_hand():
    """Members 1 and 2 behave alike: parents 0, 1, 2, 2 are behaviours a, b, b, b."""
    values = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    found = report(values, torch.tensor([0, 1, 2, 2]))
    assert found.parents.tolist() == [0, 1, 2, 2]
    assert found.depth.tolist() == [0] * 4
    assert found.distinct == 2
    assert found.effective == pytest.approx(1 / (1 / 16 + 9 / 16))


# Within POPL


def each_alone(comparisons):
    """The same comparisons, each a case of its own."""
    count = len(comparisons)
    return Comparisons(comparisons.preferred, comparisons.other, torch.arange(count), count)


def build(bank, comparisons, **settings):
    spec, training = PolicySpec(5, 2, True, (6,)), Training(steps=8, batch_size=8)
    problem = Problem(spec, bank, comparisons, training, members=6, generations=4)
    popl = POPLSettings(pooled_steps=3, **settings)
    return build_popl(problem, popl=popl, generator=seeded())


def spied(popl, monkeypatch):
    """Parents and strengths that a POPL's variation was given."""
    seen, vary = [], popl.variation

    class Spy:
        def __call__(self, parents, strength):
            seen.append((parents, strength))
            return vary(parents, strength)

        state_dict, load_state_dict = vary.state_dict, vary.load_state_dict

    monkeypatch.setattr(popl, "variation", Spy())
    return seen


def test_popl_takes_its_parents_from_the_rule_and_logs_the_same(monkeypatch, bank, comparisons):
    popl = build(bank, comparisons, selection="tournament", tournament=6)
    values = case_values(margins(popl.population, bank, comparisons) > 0, comparisons).double()
    seen = spied(popl, monkeypatch)
    metrics = popl.step()
    parents, strength = seen[0]
    sums = values.sum(1)
    assert bool((sums[parents] == sums.max()).all()), "a tournament of all has the best for winner"
    assert metrics["selection_depth"] == 0
    assert set(metrics) == set(build(bank, comparisons).step())
    # The children are still for different raters, and learn from their kin.
    assert len({tuple(row) for row in strength.tolist()}) > 1


def test_the_rule_changes_nothing_before_parents_are_chosen(monkeypatch, bank, comparisons):
    """Same first raters: from the same parents children would learn the same."""
    lexicase, other = build(bank, comparisons), build(bank, comparisons, selection="random")
    wanted = spied(lexicase, monkeypatch)
    lexicase.step()
    parents = wanted[0][0]
    monkeypatch.setattr(other, "select", lambda *_, **__: parents)
    seen = spied(other, monkeypatch)
    other.step()
    assert torch.equal(seen[0][1], wanted[0][1])


def test_mixtures_are_selected_by_the_rule_too(bank, comparisons):
    single = each_alone(comparisons)
    problem = Problem(PolicySpec(5, 2, True, (6,)), bank, single, Training(batch_size=8))
    mixture = MixtureSettings(mixtures=5, steps=2, bundle=5, first_selection=1)
    popl = build_popl(
        problem, popl=POPLSettings(selection="best_sum"), mixture=mixture, generator=seeded()
    )
    assert popl.select is best_sum_selection
    seen = []

    def rule(values, count, *, generator):
        seen.append(best_sum_selection(values, count, generator=generator))
        return seen[-1]

    popl.select = rule
    metrics = popl.step()
    assert seen[0].shape == (5,)
    assert metrics["selection_depth"] == 0
    assert metrics["effective_parents"] <= 2


def test_a_rule_of_ones_own_is_found_by_reference(tmp_path, bank, comparisons):
    """One function, in a file of its own."""
    (tmp_path / "mine.py").write_text(
        "import torch\n"
        "def first(values, count, *, generator):\n"
        "    return torch.zeros(count, dtype=torch.long)\n"
    )
    popl = build(bank, comparisons, selection=f"{tmp_path}/mine.py:first")
    assert popl.step()["effective_parents"] == 1.0
    with pytest.raises(ValueError, match="unknown selection 'lexicas'"):
        build(bank, comparisons, selection="lexicas")
