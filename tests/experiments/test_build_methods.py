import math

import pytest
import torch
from tensordict import TensorDict

from popl_rl.algorithms.cpl import GroupCPL
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.variation import GaussianHead, GradientCPL
from popl_rl.config import EvaluationConfig, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.experiments.builders import check_answers, train_baselines
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.randomness import stream


@pytest.fixture
def learning(world, tiny_groups, collect):
    data = collect(world, tiny_groups)
    bank = SegmentBank.from_segments(data.steps)
    comparisons = Comparisons.from_preferences(data.preferences, cases="rater")
    return PolicySpec.from_env(world.env, hidden=[6]), bank, comparisons


def built(learner, learning, **method):
    return learner(*learning, members=3, generations=4, training__batch_size=8, **method)


def test_gradient_popl_is_built_and_warmed_up(learner, learning):
    recipe = {"alpha": 0.2, "conservatism": 0.7, "discount": 0.9, "slip": 0.1, "bc": 2.0}
    recipe = {f"training__{name}": value for name, value in recipe.items()}
    method = {"popl__variation": "gradient", "popl__rater_similarity": False, **recipe}
    popl = built(learner, learning, **method)
    assert isinstance(popl.variation, GradientCPL)
    loss = popl.variation.loss
    assert (popl.epsilon, popl.generation, popl.generations) == ("mad", 0, 4)
    assert loss.bc == 2.0
    assert (loss.alpha, loss.conservatism, loss.discount, loss.slip) == (0.2, 0.7, 0.9, 0.1)
    assert len(popl.population) == 3
    assert popl.population.evolve == "all"
    cold = built(learner, learning, popl__warm_up=0, **method)
    pairs = zip(
        popl.population.members.data.values(True, True),
        cold.population.members.data.values(True, True),
        strict=True,
    )
    assert not any(torch.equal(warm, fresh) for warm, fresh in pairs)


def test_gaussian_popl_is_built(learner, learning):
    heads = {"popl__variation": "gaussian", "evolve": "head"}
    popl = built(learner, learning, popl__epsilon="0.1", popl__mutation_std=0.3, **heads)
    assert isinstance(popl.variation, GaussianHead)
    assert popl.variation.std == 0.3
    assert popl.epsilon == 0.1
    assert popl.population.evolve == "head"
    assert built(learner, learning, popl__epsilon=None, **heads).epsilon is None


def test_gaussian_popl_needs_heads(learner, learning):
    with pytest.raises(ValueError, match="population must have evolve='head'"):
        built(learner, learning, popl__variation="gaussian")


@pytest.mark.parametrize(
    ("method", "wanted"),
    [
        ({}, True),
        ({"refinement__steps": 0}, False),
        ({"popl__rater_similarity": False}, False),
        ({"evolve": "head"}, False),
        ({"popl__variation": "gaussian", "evolve": "head"}, False),
    ],
)
def test_only_whole_policies_of_known_raters_are_refined(learner, learning, method, wanted):
    settings = {"refinement__steps": 30, "training__alpha": 0.1, **method}
    popl = built(learner, learning, **settings)
    assert (popl.refinement is not None) == wanted
    if popl.refinement is not None:
        # How firmly scores are believed is fitted: by a power of two.
        assert math.log2(popl.result().alpha / 0.1) in range(-3, 6)


def test_unrefined_members_come_out_as_they_are(learner, learning):
    popl = built(learner, learning, refinement__steps=0)
    found = popl.result()
    members = popl.population.members.data[found.origin]
    assert (found.population.members.data == members).all()


METHODS = {
    "popl": {},
    "mixtures": {"popl__variation": "mixtures", "mixture__bundle": 5},
    "cpl": {"factory": "popl_rl.algorithms.multi_cpl:MultiCPL", "reads": ["training"]},
    "em": {"factory": "popl_rl.algorithms.em:EM", "reads": ["training", "em"]},
    "vpl": {"factory": "popl_rl.algorithms.vpl:VPL", "reads": ["training", "vpl"]},
    "lore": {"factory": "popl_rl.algorithms.lore:LoRe", "reads": ["training", "lore"]},
    "kmeans": {
        "factory": "popl_rl.algorithms.kmeans:KMeans",
        "reads": ["training", "popl", "kmeans"],
    },
}


@pytest.mark.parametrize("method", METHODS)
def test_every_method_and_the_oracle_read_the_same_recipe(learner, learning, method):
    """One object: whoever changes it changes it for all."""
    built_one = built(learner, learning, **METHODS[method])
    problem = built_one.problem
    weight = torch.ones(3, len(problem.comparisons))
    oracle = GroupCPL(problem, weight=weight, generator=stream(0, "baselines"))
    assert oracle.problem.training is problem.training
    loss = oracle.training.loss
    recipe = problem.training
    assert (loss.alpha, loss.conservatism) == (recipe.alpha, recipe.conservatism)
    assert (loss.slip, loss.discount) == (recipe.slip, recipe.discount)
    assert oracle.training.batch_size == recipe.batch_size
    assert oracle.training.steps * oracle.generations == recipe.steps


def test_em_is_told_how_many_groups_there_are_unless_it_is_told_otherwise(learner, learning):
    em = METHODS["em"]
    assert built(learner, learning, num_groups=3, **em).share.shape[1] == 3
    assert built(learner, learning, num_groups=3, em__groups=2, **em).share.shape[1] == 2


def test_a_method_that_takes_other_arguments_is_refused_by_name(learner, learning):
    with pytest.raises(TypeError, match=r"method 'popl': .*MultiCPL was called with problem"):
        built(learner, learning, **{**METHODS["cpl"], "reads": ["training", "vpl"]})
    with pytest.raises(ValueError, match="unknown method 'nonsense'"):
        built(learner, learning, factory="nonsense")


def test_vpl_needs_ids_policies_and_whole_networks(learner, learning):
    spec, bank, comparisons = learning
    vpl = METHODS["vpl"]
    count = len(comparisons)
    alone = Comparisons(comparisons.preferred, comparisons.other, torch.arange(count), count)
    with pytest.raises(ValueError, match="method vpl needs rater ids"):
        built(learner, (spec, bank, alone), **vpl)
    with pytest.raises(ValueError, match=r"method\.evolve must be all for method vpl"):
        built(learner, learning, evolve="head", **vpl)
    with pytest.raises(ValueError, match="method vpl needs a hidden layer"):
        built(learner, (RewardSpec(5, 2, ()), bank, comparisons), **vpl)


@pytest.mark.parametrize("ties", ["drop", "count", "rao_kupper"])
def test_oracles_are_told_whose_ties_are_whose(ties):
    """Group 0 wants large items, group 1 small ones; every third answer is a tie."""
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(20, 1, generator=generator)
    pair = torch.rand(240, 20, generator=generator).argsort(1)[:, :2]
    group = torch.arange(240) % 2
    larger = (value[pair[:, 1], 0] > value[pair[:, 0], 0]).long()
    answer = torch.where(group == 0, larger, 1 - larger)
    answer[::3] = 2
    preferences = {"pair": pair, "answer": answer, "rater": group, "hidden": {"group": group}}
    preferences = TensorDict(preferences, [240])
    said = Comparisons.from_preferences(preferences, cases="rater", ties=ties)
    bank = SegmentBank(value, torch.arange(20)[:, None], torch.zeros(20, 1).long(), False)
    training = Training(steps=60, batch_size=32, learning_rate=0.1, alpha=1.0)
    problem = Problem(RewardSpec(1, 1, ()), bank, said, training, generations=2)
    found = train_baselines(
        EvaluationConfig(), problem, preferences, num_groups=2, generator=generator
    )
    slope = found.population(value.sort(0).values)[..., 0].diff(dim=1).mean(1)
    assert slope[1] > 0.1
    assert slope[2] < -0.1
    assert slope[0].abs() < slope[1:].abs().min() / 2


def test_groups_that_prefer_nothing_are_named_before_anything_is_trained():
    """Raters of "level" find everything equally good; nobody belongs to "absent"."""
    pair = torch.tensor([[0, 1], [1, 2], [0, 2], [2, 1]])
    said = {"answer": torch.tensor([0, 1, 2, 2]), "hidden": {"group": torch.tensor([0, 0, 1, 1])}}
    preferences = TensorDict({"pair": pair, "rater": pair[:, 0] * 0, **said}, [4])
    comparisons = Comparisons.from_preferences(preferences, cases="rater")

    def check(names, **options):
        check_answers(EvaluationConfig(**options), comparisons, preferences, names)

    with pytest.raises(ValueError, match=r"'level' has no strict .* in all of their 2 answers"):
        check(["keen", "level"])
    preferences["answer"][2] = 0
    comparisons = Comparisons.from_preferences(preferences, cases="rater")
    check(["keen", "level"])
    with pytest.raises(ValueError, match=r"'absent' has no strict .*nobody is of this group: ask"):
        check(["keen", "level", "absent"])
    check(["keen", "level", "absent"], baselines=False)
    check(["keen", "level", "absent"], baselines_from="runs/other/baselines")
