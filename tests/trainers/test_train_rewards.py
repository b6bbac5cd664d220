"""Runs that learn reward functions: where there is nothing to do, and on two doors."""

import math
import shutil

import pandas as pd
import pytest
import torch

from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_set import RewardSet
from popl_rl.models.sets import load_set
from popl_rl.trainers import evaluate_policies, train_popl

STATELESS = [
    "env=hidden_utility",
    "data.segments=200",
    "raters.count=10",
    "raters.answers=10",
    "method.members=4",
    "method.generations=3",
    "method.training.steps=200",
    "method.hidden=[8]",
    "evaluation.episodes=100",
    "evaluation.new_raters=2",
    "evaluation.curve=[1,5]",
    "evaluation.pairs=200",
    "evaluation.brex_steps=100",
    "evaluation.dpl_steps=20",
    "evaluation.learning_curve=0",
    "evaluation.figures=false",
    "logger=csv",
]


@pytest.fixture(scope="module")
def train(config_of, tmp_path_factory):
    def run(*overrides):
        folder = tmp_path_factory.mktemp("runs") / "run"
        return train_popl.run(config_of(*STATELESS, f"run_dir={folder}", *overrides))

    return run


@pytest.fixture(scope="module")
def result(train):
    return train("evaluation.figures=true")


def same(one, other):
    names = one.population.members.data.keys(True, True)
    members = one.population.members.data, other.population.members.data
    return all(torch.equal(members[0][name], members[1][name]) for name in names)


def test_reward_functions_are_found_and_kept(result):
    assert isinstance(result.policies, RewardSet)
    assert same(RewardSet.load(result.run_dir / "rewards"), result.policies)
    assert len(load_set(result.run_dir / "baselines")) == 3
    with pytest.raises(FileNotFoundError, match="no policy set at"):
        PolicySet.load(result.run_dir / "rewards")


def test_beside_what_they_are_compared_with(result):
    results = result.board.results
    assert set(results.method) == {
        "popl",
        "bradley_terry",
        "oracle",
        "optimum",
        "brex",
        "dpl_mean_variance",
        "dpl_categorical",
        "random",
    }
    for measure in ("recovery", "accuracy"):
        values = results[(results.measure == measure) & (results.method != "random")].value
        assert values.map(math.isfinite).all()
    context = results[results.measure == "hidden_context"]
    assert set(context.method) == {"dpl_mean_variance", "dpl_categorical"}
    assert context.value.between(0, 1).all()


def test_pictures_of_utilities(result):
    names = {path.stem for path in (result.run_dir / "figures").iterdir()}
    assert {"utilities", "agreement", "members", "recovery"} <= names
    assert "majority" not in names
    assert "occupancy" not in names


def test_a_cycle_is_drawn_and_told(train):
    result = train("raters=cycle", "raters.count=12", "evaluation.figures=true")
    assert (result.run_dir / "figures" / "majority.png").is_file()
    assert "prefers in a circle" in (result.run_dir / "report.md").read_text()


def test_the_seed_decides_everything(result, train):
    again = train()
    assert same(again.policies, result.policies)
    assert again.board.results.equals(result.board.results)
    other = train("seed=1", "evaluation.baselines=false", "evaluation.reward_baselines=false")
    assert not same(other.policies, result.policies)


def test_a_finished_run_is_judged_again(result, config_of, tmp_path):
    shutil.copytree(result.run_dir, tmp_path / "run")
    overrides = [f"run_dir={tmp_path / 'run'}", "evaluation.episodes=50"]
    folder, board = evaluate_policies.run(config_of(*overrides, name="evaluate"))
    assert {"popl", "bradley_terry", "oracle"} <= set(board.results.method)
    assert len(pd.read_csv(folder / "results.csv")) == len(board.results)


@pytest.mark.parametrize(
    "overrides",
    [["method=popl_published", "method.members=6", "method.generations=2"], ["method.evolve=head"]],
)
def test_other_ways_of_learning_them(train, overrides):
    result = train(*overrides)
    assert result.policies.population.evolve == "head"
    assert math.isfinite(result.board.value(result.board.label, "zeroed", "recovery"))


def test_features_trained_on_everybody(train):
    heads = (
        "method.evolve=head",
        "evaluation.baselines=false",
        "evaluation.reward_baselines=false",
    )
    result = train(*heads, "method.popl.features=pooled", "method.popl.pooled_steps=20")
    plain = train(*heads)
    trunks = [r.policies.population.trunk.state_dict()["0.weight"] for r in (result, plain)]
    assert not torch.equal(*trunks)


def test_there_is_no_policy_to_learn(train):
    with pytest.raises(ValueError, match=r"method\.learns must be reward"):
        train("method.learns=policy")


def test_rewards_of_two_doors_are_planned_for(config_of, tiny, tmp_path):
    overrides = [*tiny, "method.learns=reward", "evaluation.figures=true"]
    result = train_popl.run(config_of(*overrides, f"run_dir={tmp_path / 'run'}"))
    assert isinstance(result.policies, RewardSet)
    assert (result.run_dir / "figures" / "occupancy.png").is_file()
    # Planning reaches the goal whatever the reward says of the doors.
    assert result.board.value("oracle", "upper", "success") > 0.5
