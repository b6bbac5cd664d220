"""Does it learn? The main job at its default settings; minutes, so marked slow."""

import pytest

from popl_rl.config import Config, EnvConfig, RatersConfig
from popl_rl.report import summary
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
    table = summary({"run": result.board.results}).set_index("method")
    return table.worst_recovery, table.accuracy_gap


def test_each_of_two_hidden_groups_finds_its_policy_and_pooled_cpl_serves_neither(tmp_path):
    config = Config(env=two_doors(doors=2), raters=RatersConfig(groups=["upper", "lower"]))
    config.logger.name, config.run_dir = "csv", str(tmp_path / "run")
    recovery, gap = worst(run(config))
    assert recovery["popl"] >= 0.9
    assert gap["popl"] <= 0.03
    assert recovery["cpl"] <= 0.5


def test_each_of_three_hidden_groups_finds_its_policy(tmp_path):
    groups = ["upper", "lower", "third"]
    config = Config(env=two_doors(doors=3), raters=RatersConfig(groups=groups), seed=1)
    config.logger.name, config.run_dir = "csv", str(tmp_path / "run")
    recovery, gap = worst(run(config))
    # A third of the answers each is little: the oracles themselves reach 0.36 to 1.00 success, and
    # the worst group's recovery was 0.63 to 0.92 over five seeds.
    assert recovery["popl"] >= 0.6
    assert recovery["popl"] >= recovery["cpl"] + 0.3
    assert gap["popl"] <= 0.05
