import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from popl_rl.algorithms.popl import POPL
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.variation import GaussianHead, GradientCPL
from popl_rl.config import DataConfig, EnvConfig, MethodConfig, RatersConfig, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.measures import group_accuracy, held_out_pairs
from popl_rl.experiments.builders import build_method, build_problem
from popl_rl.experiments.data import build_groups, build_world, make_data
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.scoring import case_values, margins, rater_accuracy, segment_scores
from popl_rl.randomness import stream
from popl_rl.selection.mad import mad


def make(bank, comparisons, *, variation="gradient", seed=0, members=6, epsilon="mad"):
    """A small POPL on the line of five cells."""
    generator = torch.Generator().manual_seed(seed)
    evolve = "head" if variation == "gaussian" else "all"
    problem = Problem(
        PolicySpec(5, 2, True, (8,)),
        bank,
        comparisons,
        Training(steps=20, batch_size=16),
        evolve=evolve,
        members=members,
        generations=10,
    )
    population = problem.initial_population(members, generator=generator)
    if variation == "gaussian":
        varied = GaussianHead(population, generator=generator)
    else:
        varied = GradientCPL.of(problem, population, generator=generator)
    return POPL(
        problem, population=population, variation=varied, epsilon=epsilon, generator=generator
    )


def parameters_of(popl):
    return [value.clone() for value in popl.population.members.data.values(True, True)]


def equal(one, other):
    return all(map(torch.equal, one, other))


def three_comparisons(case, num_cases):
    preferred, other = torch.tensor([0, 2, 1]), torch.tensor([1, 0, 2])
    return Comparisons(preferred, other, torch.tensor(case), num_cases)


def test_margins_by_hand():
    """A linear policy on one observation, logits (ln 2, 0): probabilities 2/3 and 1/3.

    Segments of one step take action 0, 1 and 0, so scores with alpha = 3 are 3 ln(2/3), 3 ln(1/3)
    and 3 ln(2/3). Comparisons 0 over 1, 2 over 0 and 1 over 2 have margins 3 ln 2, 0 and -3 ln 2.
    """
    population = Population.create(
        PolicySpec(1, 2, True, ()), 1, generator=torch.Generator().manual_seed(0)
    )
    population.members.data["0", "weight"].zero_()
    population.members.data["0", "bias"].copy_(torch.tensor([[math.log(2), 0.0]]))
    bank = SegmentBank(
        torch.ones(1, 1), torch.zeros(3, 1, dtype=torch.long), torch.tensor([[0], [1], [0]]), True
    )
    comparisons = three_comparisons([0, 1, 2], 3)
    result = margins(population, bank, comparisons, alpha=3.0)
    torch.testing.assert_close(result, torch.tensor([[3 * math.log(2), 0.0, -3 * math.log(2)]]))


@given(st.integers(0, 2**31), st.booleans(), st.floats(0.5, 1.0))
@settings(max_examples=15, deadline=None)
def test_swapping_sides_negates_margins(seed, discrete, discount):
    generator = torch.Generator().manual_seed(seed)
    population = Population.create(PolicySpec(2, 3, discrete, (4,)), 3, generator=generator)
    if discrete:
        action = torch.randint(3, (6, 4), generator=generator)
    else:
        action = torch.randn(6, 4, 3, generator=generator)
    observation = torch.randn(24, 2, generator=generator)
    bank = SegmentBank(observation, torch.arange(24).view(6, 4), action, False)
    rows = torch.randint(6, (2, 10), generator=generator)
    case = torch.zeros(10, dtype=torch.long)
    one = margins(population, bank, Comparisons(*rows, case, 1), discount=discount)
    other = margins(population, bank, Comparisons(*rows.flip(0), case, 1), discount=discount)
    assert torch.equal(one, -other)
    scores = segment_scores(population, bank, discount=discount)
    assert torch.equal(one, scores[:, rows[0]] - scores[:, rows[1]])


def test_case_values_by_hand():
    """Case 0 holds comparisons 0 and 2, case 1 comparison 1, case 2 none (its value is 0)."""
    passes = torch.tensor([[True, False, False], [True, True, True]])
    values = case_values(passes, three_comparisons([0, 1, 0], 3))
    assert values.tolist() == [[0.5, 0.0, 0.0], [1.0, 1.0, 0.0]]


def test_single_preferences_as_cases_are_the_passes():
    passes = torch.tensor([[True, False, True], [False, False, True]])
    values = case_values(passes, three_comparisons([0, 1, 2], 3))
    assert torch.equal(values, passes.float())


def test_median_absolute_deviation_by_hand():
    """Column 1, 2, 3, 4, 100: median 3, deviations 2, 1, 0, 1, 97, their median 1.

    Column 0, 0, 0, 1, 1: median 0, deviations the same, their median 0.
    """
    values = torch.tensor([[1.0, 2.0, 3.0, 4.0, 100.0], [0.0, 1.0, 0.0, 1.0, 0.0]]).T
    assert mad(values).tolist() == [1.0, 0.0]


def test_the_worst_raters_accuracy_by_hand():
    """Best member's values for four raters: 0.5, 1, 0.9, 0.2; the median is (0.5 + 0.9) / 2."""
    values = torch.tensor([[0.5, 0.0, 0.9, 0.2], [0.1, 1.0, 0.3, 0.1]])
    assert rater_accuracy(values, 0.5) == pytest.approx(0.7)
    assert rater_accuracy(values, 0.0) == pytest.approx(0.2)


class Remember:
    """A variation that changes nothing and remembers what it was told."""

    def __init__(self):
        self.calls = []

    def __call__(self, parents, strength):
        self.calls.append((parents, strength))
        return {"told": 1.0}

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def one_generation(monkeypatch, bank, margin, comparisons, epsilon):
    """Run a generation on given margins; return what the variation was told, and the scalars."""
    # Segments of the comparisons' own, whose scores have these margins.
    rows = torch.arange(len(comparisons))
    comparisons = replace(comparisons, preferred=rows, other=rows + len(rows))
    scores = torch.cat([margin, torch.zeros_like(margin)], 1)
    monkeypatch.setattr(Problem, "compared_scores", lambda *_: scores)
    generator = torch.Generator().manual_seed(0)
    spec = PolicySpec(5, 2, True, ())
    population = Population.create(spec, len(margin), generator=generator)
    remember = Remember()
    problem = Problem(spec, bank, comparisons)
    popl = POPL(
        problem,
        population=population,
        variation=remember,
        epsilon=epsilon,
        generator=generator,
    )
    metrics = popl.step()
    assert popl.generation == 1
    return *remember.calls[0], metrics


@pytest.mark.parametrize(
    ("epsilon", "strong"),
    [(None, [[1, 1, 0], [0, 0, 1], [0, 0, 0]]), (0.5, [[1, 1, 0], [1, 1, 1], [1, 1, 0]])],
)
def test_a_generation_by_hand(monkeypatch, bank, epsilon, strong):
    """Three members; rater 0 made comparisons 0 and 1, rater 1 comparison 2.

    Member 0 passes both of rater 0, member 1 one of rater 0 and rater 1's, member 2 one of rater
    0's (a margin of 0 is no pass). Values are (1, 0), (1/2, 1) and (1/2, 0), so the best are 1 and
    1: without tolerance member 0 is strong for rater 0, member 1 for rater 1, and member 2 is never
    selected. With a tolerance of 1/2 all are strong for rater 0.
    """
    margin = torch.tensor([[1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 0.0]])
    comparisons = three_comparisons([0, 0, 1], 2)
    parents, strength, metrics = one_generation(monkeypatch, bank, margin, comparisons, epsilon)
    assert parents.shape == (3,)
    assert strength[:, comparisons.case].tolist() == [strong[parent] for parent in parents]
    if epsilon is None:
        assert set(parents.tolist()) <= {0, 1}
    assert metrics["worst_rater_accuracy"] == pytest.approx(1.0)
    assert metrics["mean_accuracy"] == pytest.approx(5 / 9)
    assert metrics["distinct"] == 3
    assert metrics["told"] == 1.0
    assert 0 < metrics["selection_depth"] <= 2
    assert 1 <= metrics["effective_parents"] <= 3


def test_tolerance_from_the_population_by_hand(monkeypatch, bank):
    """Two raters with four comparisons each; values of the members in quarters.

    Rater 0: 1, 3/4, 1/4: median 3/4, deviations 1/4, 0, 1/2, their median 1/4, so members of at
    least 3/4 are strong. Rater 1: 0, 0, 1: median 0, deviations 0, 0, 1, their median 0, so member
    2 alone is strong.
    """
    passes = [[1, 1, 1, 1, 0, 0, 0, 0], [1, 1, 1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 1, 1, 1, 1]]
    rows = torch.arange(8)
    comparisons = Comparisons(rows, rows + 8, rows // 4, 2)
    margin = torch.tensor(passes) - 0.5
    parents, strength, _ = one_generation(monkeypatch, bank, margin, comparisons, "mad")
    assert strength[:, 0].tolist() == [[1, 1, 0][parent] for parent in parents]
    assert strength[:, 1].tolist() == [[0, 0, 1][parent] for parent in parents]


@pytest.mark.parametrize("variation", ["gradient", "gaussian"])
def test_the_seed_decides_everything(bank, comparisons, variation):
    def run(seed):
        popl = make(bank, comparisons, variation=variation, seed=seed)
        return [popl.step() for _ in range(3)], parameters_of(popl)

    metrics, parameters = run(0)
    again, same = run(0)
    assert metrics == again
    assert equal(parameters, same)
    _, other = run(1)
    assert not any(map(torch.equal, parameters, other))


@pytest.mark.parametrize("variation", ["gradient", "gaussian"])
@pytest.mark.parametrize("after", [0, 2])
def test_continuing_is_as_never_having_stopped(bank, comparisons, variation, after):
    straight = make(bank, comparisons, variation=variation)
    for _ in range(after):
        straight.step()
    state = straight.state_dict()
    expected = [straight.step() for _ in range(3)]

    # Heads need the trunk that they were trained on; all else comes from the state.
    resumed = make(bank, comparisons, variation=variation, seed=9 if variation == "gradient" else 0)
    resumed.step()
    resumed.load_state_dict(state)
    assert resumed.generation == after
    assert [resumed.step() for _ in range(3)] == expected
    assert equal(parameters_of(resumed), parameters_of(straight))
    assert resumed.generation == straight.generation == after + 3


@pytest.mark.parametrize("variation", ["gradient", "gaussian"])
def test_a_state_can_be_loaded_twice(bank, comparisons, variation):
    """Loading hands out no tensor that the run it came from, or another one, still writes to."""
    popl = make(bank, comparisons, variation=variation)
    popl.step()
    state = popl.state_dict()
    runs = [make(bank, comparisons, variation=variation) for _ in range(2)]
    for run in runs:
        run.load_state_dict(state)
    for run in (popl, *runs):
        run.step()
    for run in runs:
        assert equal(parameters_of(run), parameters_of(popl))


def test_every_generation_moves_the_members_and_reports_numbers(bank, comparisons):
    popl = make(bank, comparisons)
    before = parameters_of(popl)
    metrics = popl.step()
    assert set(metrics) == {
        "worst_rater_accuracy",
        "mean_accuracy",
        "selection_depth",
        "distinct",
        "effective_parents",
        "loss_cpl",
    }
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    assert not any(map(torch.equal, before, parameters_of(popl)))


def test_two_hidden_groups_each_find_a_policy():
    """Two doors, 60 raters without labels: some member ranks 70 % of each group's pairs right."""
    world = build_world(
        EnvConfig(
            factory="popl_rl.envs.two_doors:two_doors",
            data_options={"start": "anywhere"},
            mixture={"planner/*": 0.5, "explorer": 0.5},
        )
    )
    names = ["popl_rl.envs.two_doors:upper", "popl_rl.envs.two_doors:lower"]
    raters = RatersConfig(groups=names, count=60, answers=20)
    data = make_data(
        DataConfig(segments=1500, length=8),
        raters,
        world,
        build_groups(raters, world),
        seed=0,
        env=EnvConfig(max_steps=60),
    )
    bank = SegmentBank.from_segments(data.steps)
    recipe = Training(steps=225, batch_size=64, learning_rate=5e-3)
    method = MethodConfig(members=16, generations=15, hidden=[32], training=recipe)
    comparisons = Comparisons.from_preferences(data.preferences, cases="rater")
    spec = PolicySpec.from_env(world.env, hidden=method.hidden)
    problem = build_problem(method, spec, bank, comparisons)
    popl = build_method(method, problem, num_groups=2, generator=stream(0, "learner"))
    for _ in range(method.generations):
        popl.step()
    draw = stream(0, "held-out pairs")
    pairs = {
        group: held_out_pairs(data.segment_utility, group, count=2000, generator=draw)
        for group in (0, 1)
    }
    accuracy = group_accuracy(segment_scores(popl.population, bank), pairs)
    assert bool((accuracy.amax(0) > 0.7).all()), accuracy
    assert accuracy[:, 0].argmax() != accuracy[:, 1].argmax()
