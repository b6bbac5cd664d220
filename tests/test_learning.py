"""Does it learn? The main job at its default settings; minutes, so marked slow."""

import pytest

from popl_rl.config import Config, EnvConfig, RatersConfig
from popl_rl.evaluation.statistics import summary
from popl_rl.trainers.train_popl import run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]


def two_doors(**options):
    return EnvConfig(
        options={"size": 9, **options},
        data_options={"start": "mixed"},
        mixture={"planner/*": 0.5, "explorer": 0.5},
        door="door",
    )


def worst(result):
    table = summary({"run": result.board.results})
    table = table[table.choice.isin(["", "posterior"])].set_index("method")
    return table.worst_recovery, table.accuracy_gap


def test_each_of_two_hidden_groups_finds_its_policy_and_pooled_cpl_serves_neither(tmp_path):
    config = Config(env=two_doors(doors=2), raters=RatersConfig(groups=["upper", "lower"]))
    config.logger.name, config.run_dir = "csv", str(tmp_path / "run")
    recovery, gap = worst(run(config))
    assert recovery["popl"] >= 0.9
    assert gap["popl"] <= 0.03
    assert recovery["pooled_cpl"] <= 0.5


def test_each_of_three_hidden_groups_finds_its_policy(tmp_path):
    groups = ["upper", "lower", "third"]
    config = Config(env=two_doors(doors=3), raters=RatersConfig(groups=groups), seed=1)
    config.logger.name, config.run_dir = "csv", str(tmp_path / "run")
    recovery, gap = worst(run(config))
    assert recovery["popl"] >= 0.85
    assert recovery["popl"] >= recovery["pooled_cpl"] + 0.5
    assert gap["popl"] <= 0.05


def test_groups_are_found_without_rater_ids(tmp_path):
    """A seed on which the search for a team has failed before."""
    config = Config(env=two_doors(doors=2), raters=RatersConfig(groups=["upper", "lower"]), seed=4)
    config.method.cases = "preference"
    config.logger.name, config.run_dir = "csv", str(tmp_path / "run")
    recovery, _ = worst(run(config))
    assert recovery["popl"] >= 0.8


def test_fast_and_gentle_find_their_policies_in_metaworld(config_of, tmp_path):
    """A quarter of the data that a full run has, cloned for a third of the time."""
    config = config_of(
        "env=metaworld/button_press",
        "data.segments=400",
        "evaluation.pairs=120",  # six of each of the twenty states that are kept
        f"data.store={tmp_path / 'store'}",
        "method.clone.steps=1000",
        "method.members=12",
        "method.generations=8",
        "evaluation.episodes=6",
        "evaluation.curve=[]",
        "evaluation.animate=false",
        "logger=csv",
        f"run_dir={tmp_path / 'run'}",
    )
    result = run(config)
    board = result.board
    recovery, _ = worst(result)
    assert recovery["popl"] >= 0.8
    assert recovery["popl"] >= recovery["pooled_cpl"] + 0.2
    peak = {}
    for group in ("fast", "gentle"):
        assert board.value("popl", group, "success") >= 0.8
        assert board.value("oracle", group, "success") >= 0.8
        peak[group] = board.value("popl", group, "peak_hand_speed")
    assert peak["gentle"] <= 0.7 * peak["fast"]
