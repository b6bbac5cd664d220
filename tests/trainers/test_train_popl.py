import json
import math
import multiprocessing
from dataclasses import replace

import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

from popl_rl.config import EvaluateConfig
from popl_rl.evaluation.statistics import RESULT_COLUMNS, read_results
from popl_rl.models.encoded_policy_set import EncodedPolicySet
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.randomness import stream
from popl_rl.trainers import evaluate_policies
from popl_rl.trainers.train_popl import run, show

MIXTURES = [
    "method.cases=preference",
    "method.mixture.mixtures=3",
    "method.mixture.generations=2",
    "method.mixture.steps=10",
    "method.mixture.final_steps=50",
]
GYM = ["env=gym", "env.id=CartPole-v1", "raters.label=return", "env.max_steps=30"]
RATERS = """
def slow(segments):
    return -segments["observation"][..., 1].abs()


def upright(segments):
    return -segments["observation"][..., 2].abs()
"""

#: Rows of what the data show and of the optimum, whatever is evaluated.
IN_ANY_CASE = ("behaviour", "best_behaviour", "data", "optimum")


@pytest.fixture(scope="module")
def train(tmp_path_factory, tiny, config_of):
    """Run the trainer in a new folder with a few overrides."""

    def train(*overrides):
        folder = tmp_path_factory.mktemp("run") / "run"
        elsewhere = any(override.startswith("env=") for override in overrides)
        settings = tiny[1:] if elsewhere else tiny
        return run(config_of(*settings, f"run_dir={folder}", *overrides))

    return train


@pytest.fixture(scope="module")
def result(finished):
    return finished


def tensors(policies):
    return dict(policies.population.members.data.items(True, True))


def equal(one, other):
    one, other = tensors(one), tensors(other)
    same_shapes = all(one[name].shape == other[name].shape for name in one)
    return same_shapes and all(torch.equal(one[name], other[name]) for name in one)


def test_a_run_leaves_everything_behind(result):
    found = {path.name for path in result.run_dir.iterdir()}
    assert found == {
        ".lock",
        "baselines",
        "checkpoint",
        "config.yaml",
        "data",
        "figures",
        "history.csv",
        "manifest.json",
        "metadata.json",
        "metrics.csv",
        "policies",
        "report.md",
        "results.csv",
    }
    pictures = {path.name for path in (result.run_dir / "figures").iterdir()}
    assert {"learning.png", "selection.png", "recovery.png", "members.png"} <= pictures
    assert all(path.stat().st_size > 1000 for path in (result.run_dir / "figures").iterdir())
    report = (result.run_dir / "report.md").read_text()
    assert all(f"figures/{name}" in report for name in pictures)
    assert json.loads((result.run_dir / "metadata.json").read_text())["versions"]["torchrl"]
    stored = OmegaConf.load(result.run_dir / "config.yaml")
    assert stored.data.segments == 200
    assert list(stored.raters.groups) == ["upper", "lower"]


def test_a_row_for_each_generation(result):
    metrics = pd.read_csv(result.run_dir / "metrics.csv")
    assert metrics.generation.tolist() == [1, 2, 3]
    assert metrics.notna().all(axis=None)
    history = pd.read_csv(result.run_dir / "history.csv")
    assert history.generation.tolist() == [1, 3]
    assert set(history) == {"generation"} | {
        f"{group}/{member}" for group in ("upper", "lower") for member in range(4)
    }


def test_results_are_tidy_and_complete(result):
    results = read_results(result.run_dir / "results.csv")
    assert list(results) == RESULT_COLUMNS
    pd.testing.assert_frame_equal(results, result.board.results)
    assert not results.duplicated(RESULT_COLUMNS[:-1]).any()
    for method in ("popl", "pooled_cpl", "oracle"):
        for group in ("upper", "lower"):
            for measure in ("recovery", "return", "success", "accuracy", "best_accuracy"):
                value = result.board.value(method, group, measure)
                assert math.isfinite(value), (method, group, measure)
                if measure not in ("recovery", "return"):
                    assert 0 <= value <= 1
    for group in ("upper", "lower"):
        assert result.board.value("oracle", group, "recovery") == 1
        assert result.board.value("random", group, "recovery") == 0


def test_training_moves_every_tensor(result):
    spec = PolicySpec.from_env(world_of_two_doors(), hidden=[8])
    initial = Population.create(spec, 4, generator=stream(0, "learner")).members.data
    trained = tensors(result.policies)
    assert set(trained) == set(initial.keys(True, True))
    for name, value in trained.items():
        assert bool(value.isfinite().all())
        moved = (value.unsqueeze(1) != initial[name].unsqueeze(0)).flatten(2).any(2)
        assert moved.all(), name  # no member of the set is one of the first population


def world_of_two_doors():
    from popl_rl.envs.two_doors import two_doors

    return two_doors(size=7, doors=2)


def test_what_is_saved_is_what_was_found(result):
    assert equal(PolicySet.load(result.run_dir / "policies"), result.policies)
    assert len(PolicySet.load(result.run_dir / "baselines")) == 3


def test_the_seed_decides_everything(result, train):
    again = train()
    assert equal(again.policies, result.policies)
    assert again.board.results.equals(result.board.results)
    other = train("seed=1", "evaluation.baselines=false", "evaluation.episodes=2")
    assert not equal(other.policies, result.policies)


def test_data_of_an_earlier_run_gives_the_same_policies(result, train):
    again = train(f"data.load={result.run_dir / 'data'}")
    assert equal(again.policies, result.policies)
    assert again.board.results.equals(result.board.results)


def test_the_alarm_is_said_in_the_terminal(result, capsys):
    for gain in (0.0, 1.0):
        results = result.board.results.copy()
        results.loc[results.measure == "gain", "value"] = gain
        results.loc[results.measure == "gain_error", "value"] = 0.1
        show(replace(result, board=replace(result.board, results=results)))
        assert ("alarm: the set meets" in capsys.readouterr().out) == (gain == 0)


def test_the_report_tells_how_new_raters_are_met(result):
    report = (result.run_dir / "report.md").read_text()
    assert "| new raters' further answers | " in report
    assert "| POPL (catered) | all |" not in report, "a group of its own only in results.csv"


def test_without_baselines(train):
    result = train("evaluation.baselines=false", "evaluation.figures=true")
    assert set(result.board.results.method) == {"popl", "random", *IN_ANY_CASE}
    assert not (result.run_dir / "baselines").exists()
    assert (result.run_dir / "report.md").is_file()


def test_an_oracle_no_better_than_random_leaves_recovery_open(train):
    """Nobody reaches the goal in three steps, so all policies are worth the same."""
    short = ("env.max_steps=3", "data.length=3", "evaluation.episodes=2")
    result = train(*short, "evaluation.figures=true")
    pictures = {path.stem for path in (result.run_dir / "figures").iterdir()}
    assert {"learning", "members", "recovery"} <= pictures
    assert (result.run_dir / "report.md").is_file()


def test_the_published_method(train):
    result = train("method=popl_published", "method.members=8", "method.hidden=[16]")
    assert result.policies.population.evolve == "head"
    assert math.isfinite(result.board.value("popl_published", "upper", "recovery"))


def test_mixtures_without_rater_ids(train, capsys):
    result = train(*MIXTURES, "raters.answers=20")
    assert 1 <= len(result.policies) <= 4
    metrics = pd.read_csv(result.run_dir / "metrics.csv")
    assert metrics.generation.tolist() == [1, 2]
    assert {"held_out_likelihood", "mixture_size"} <= set(metrics)
    assert math.isfinite(result.board.value("popl", "lower", "recovery"))
    show(result)
    assert "upper" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("method", "label", "found"),
    [
        ("cpl", "cpl", PolicySet),
        ("multi_cpl", "multi_cpl", PolicySet),
        ("em", "em", PolicySet),
        ("vpl", "vpl", EncodedPolicySet),
        ("popl_tournament", "popl_tournament", PolicySet),
        ("popl_nsga2", "popl_nsga2", PolicySet),
    ],
)
def test_methods_to_compare_with(train, method, label, found):
    result = train(f"method={method}", "evaluation.episodes=4", "evaluation.figures=true")
    assert type(result.policies) is found
    results = result.board.results
    assert set(results.method) == {label, "pooled_cpl", "oracle", "random", *IN_ANY_CASE}
    assert not results.duplicated(RESULT_COLUMNS[:-1]).any()
    metrics = pd.read_csv(result.run_dir / "metrics.csv")
    assert metrics.generation.tolist() == [1, 2, 3]
    assert metrics.notna().all(axis=None)
    assert set(pd.read_csv(result.run_dir / "history.csv").generation) == {1, 3}
    report = (result.run_dir / "report.md").read_text()
    assert report.startswith("# POPL: ") == (label == "popl")
    pictures = {path.stem for path in (result.run_dir / "figures").iterdir()}
    assert {"learning", "members", "occupancy"} <= pictures
    assert ("selection" in pictures) == method.startswith("popl")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_wandb_writes_offline(train):
    result = train("logger=wandb")
    assert list((result.run_dir / "wandb").glob("offline-run-*"))


def test_any_gymnasium_environment_with_raters_from_a_file(train, tmp_path):
    file = tmp_path / "my_raters.py"
    file.write_text(RATERS)
    result = train(*GYM, f"raters.groups=['{file}:slow','{file}:upright']")
    kept = result.run_dir / "plug_ins" / "0" / "my_raters.py"
    assert kept.read_text() == RATERS
    groups = set(result.board.results.group) - {"all"}
    assert len(groups) == 2
    assert all(math.isfinite(result.board.value("popl", group, "return")) for group in groups)


@pytest.mark.slow  # two runs; test_process_rollouts.py is short
def test_two_workers_change_no_bit_of_a_run(train, tmp_path):
    file = tmp_path / "my_raters.py"
    file.write_text(RATERS)
    settings = (*GYM, f"raters.groups=['{file}:slow','{file}:upright']")
    others = set(multiprocessing.active_children())
    alone, parallel = train(*settings), train(*settings, "workers=2")
    assert set(multiprocessing.active_children()) <= others
    for name in ("results.csv", "history.csv", "metrics.csv"):
        one, other = alone.run_dir / name, parallel.run_dir / name
        assert one.read_bytes() == other.read_bytes(), name
    assert equal(alone.policies, parallel.policies)
    again = EvaluateConfig(run_dir=str(alone.run_dir), seed=0, workers="2")
    _, board = evaluate_policies.run(again)
    pd.testing.assert_frame_equal(board.results, alone.board.results)


def test_three_doors_and_three_groups(train):
    result = train("raters=three_groups", "env.options.doors=3", "env.options.size=7")
    assert set(result.board.results.group) == {"upper", "lower", "third", "all"}
    assert len(PolicySet.load(result.run_dir / "baselines")) == 4


def test_an_environment_from_a_file(train, tmp_path):
    file = tmp_path / "my_env.py"
    file.write_text(
        "from popl_rl.testing import tiny_env\n\n\ndef make(steps=8):\n"
        "    return tiny_env(max_steps=steps)\n"
    )
    result = train(
        "env=custom",
        f"env.factory={file}:make",
        "+env.options.steps=10",
        "env.max_steps=10",
        "raters.groups=['popl_rl.testing:likes_left','popl_rl.testing:likes_right']",
    )
    groups = sorted(set(result.board.results.group) - {"all"})
    assert len(groups) == 2
    assert math.isnan(result.board.value("popl", groups[0], "success"))
    assert math.isfinite(result.board.value("popl", groups[0], "return"))


@pytest.mark.filterwarnings("default:all .* members are needed")  # a tiny run has few
def test_niches_tell_how_well_each_size_predicts(train):
    run_dir = train("method=popl_niches", "method.niches.specialists=20").run_dir
    sizes = pd.read_csv(run_dir / "sizes.csv")
    assert sizes.members.tolist() == list(range(1, len(sizes) + 1))
    assert sizes.log_likelihood.lt(0).all()
    assert sizes.error[sizes.log_likelihood.argmax()] == 0
