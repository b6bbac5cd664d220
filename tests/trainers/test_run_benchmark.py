"""popl-benchmark, with a trainer that only writes down what it was asked, but for one real run."""

import json
import shutil
import sys
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf

from popl_rl.evaluation.statistics import RESULT_COLUMNS, read_results
from popl_rl.experiments import benchmark_report
from popl_rl.experiments.run_folder import save_config, write_metadata
from popl_rl.trainers import benchmark_cells, run_benchmark
from popl_rl.trainers.run_benchmark import BenchmarkConfig, run

SUITE = """
methods:
  popl: []
  other: [method=popl_published]
scenarios:
  plain: []
  noisy: [raters.response.mistake=0.1]
"""
CELLS = [f"{s}/{m}/seed0" for m in ("popl", "other") for s in ("plain", "noisy")]


def name_of(folder):
    """Name of a cell, from its folder."""
    return "/".join(folder.parts[-3:])


class Trainer:
    """Stands in for ``popl_rl.trainers.train_popl.run``."""

    def __init__(self):
        self.configs = []
        self.resumed = []
        self.fails = {}

    @property
    def cells(self):
        return [name_of(Path(config.run_dir)) for config in self.configs]

    def __call__(self, config):
        if config.resume is not None:
            self.resumed.append(config.resume)
            folder = Path(config.resume)
        else:
            self.configs.append(config)
            folder = Path(config.run_dir)
            folder.mkdir(parents=True)
            save_config(folder, config)
            write_metadata(folder, command=["test"])
        if name_of(folder) in self.fails:
            raise self.fails.pop(name_of(folder))
        if config.data.save:
            (folder / "data" / "segments").mkdir(parents=True, exist_ok=True)
            (folder / "baselines").mkdir(exist_ok=True)
        value = 0.9 if config.method.name == "popl" else 0.4
        own, group = config.method.name, ("upper", "recovery")
        rows = [
            (own, "posterior", *group, value - 0.01 * config.seed),
            (own, "lexicase", *group, 0.2),
            ("pooled_cpl", "", *group, 0.1),
        ]
        table = pd.DataFrame(rows, columns=RESULT_COLUMNS)
        table.to_csv(folder / "results.csv", index=False)


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    Path("mine.yaml").write_text(SUITE)


compose = cache(benchmark_cells.compose_settings)


def nothing_to_draw(suite, results):
    raise ValueError


@pytest.fixture
def trainer(monkeypatch):
    trainer = Trainer()
    monkeypatch.setattr(benchmark_cells.train_popl, "run", trainer)
    # Both take longer than all the rest.
    monkeypatch.setattr(
        benchmark_cells, "compose_settings", lambda overrides: compose(tuple(overrides))
    )
    monkeypatch.setattr(benchmark_report, "scenario_bars", nothing_to_draw)
    return trainer


def config(**changes):
    options = {"suite": "mine.yaml", "seeds": 1, "workers": 0, "run_dir": "out", **changes}
    return BenchmarkConfig(**options)


def cell_folder(name):
    return Path("out/cells") / name


def test_every_cell_is_run_once_and_the_results_are_put_together(trainer):
    result = run(config(seeds=2))
    assert trainer.cells[:4] == CELLS
    assert len(trainer.cells) == 8
    assert result.failures == {}
    results = read_results(Path("out/results.csv"))
    assert list(results) == ["suite", "scenario", "seed", *RESULT_COLUMNS]
    assert set(results.suite) == {"mine"}
    chosen = results[(results.measure == "recovery") & (results.scenario == "noisy")]
    of = chosen.set_index(["method", "choice", "seed"]).value.to_dict()
    assert of["popl", "posterior", 1] == pytest.approx(0.89)
    assert of["other", "posterior", 0] == 0.4
    assert of["other", "lexicase", 1] == 0.2
    assert of["pooled_cpl", "", 0] == 0.1
    assert len(of) == 10
    assert len(results[results.measure == "seconds"]) == 8
    report = Path("out/report.md").read_text()
    assert "| method | plain | noisy |" in report
    assert "| popl | **0.90 ± 0.06 [0.89]** | **0.90 ± 0.06 [0.89]** |" in report
    assert len(pd.read_csv("out/cells.csv")) == 8
    assert not list(Path("out/logs").rglob("*.txt")), "nothing was printed"


def test_all_methods_of_a_scenario_and_seed_see_the_data_of_the_first(trainer):
    run(config(seeds=2))
    configs = dict(zip(trainer.cells, trainer.configs, strict=True))
    first, second = configs["noisy/popl/seed1"], configs["noisy/other/seed1"]
    assert (first.seed, second.seed) == (1, 1)
    assert first.data.load is None
    assert first.data.save
    assert second.data.load == "out/cells/noisy/popl/seed1/data"
    assert not second.data.save
    assert first.evaluation.baselines_from is None
    assert second.evaluation.baselines_from == "out/cells/noisy/popl/seed1/baselines"
    assert first.raters == second.raters
    assert second.raters.response.mistake == 0.1
    assert first.evaluation.reward_baselines
    assert not second.evaluation.reward_baselines
    assert {one.logger.name for one in trainer.configs} == {"csv"}
    assert {one.threads for one in trainer.configs} == {1}
    record = json.loads((cell_folder("noisy/other/seed1") / "cell.json").read_text())
    assert record["overrides"] == ["raters.response.mistake=0.1", "method=popl_published"]


def test_only_the_maker_of_the_data_trains_further_methods_for_its_scenarios(trainer):
    """Where another method leads a scenario, they would be trained in another way."""
    more = "  sizes: {overrides: [method.members=9], methods: [other], data_of: plain}\n"
    more += "  judges: {overrides: [evaluation.answers=9], data_of: plain}\n"
    Path("mine.yaml").write_text(SUITE + more)
    run(config())
    trained = [
        cell
        for cell, one in zip(trainer.cells, trainer.configs, strict=True)
        if one.evaluation.reward_baselines
    ]
    assert trained == ["plain/popl/seed0", "noisy/popl/seed0", "judges/popl/seed0"]


def test_without_baselines_there_are_none_to_share(trainer):
    Path("mine.yaml").write_text(SUITE + "overrides: [evaluation.baselines=false]\n")
    run(config())
    shutil.rmtree(cell_folder("plain/popl/seed0") / "baselines")
    shutil.rmtree(cell_folder("plain/other/seed0"))
    run(config())
    assert trainer.configs[-1].evaluation.baselines_from is None


def test_what_is_finished_is_not_run_again(trainer):
    before = run(config())
    again = run(config())
    assert len(trainer.cells) == 4
    pd.testing.assert_frame_equal(before.results, again.results)
    run(config(seeds=2))
    assert len(trainer.cells) == 8


def kill(name):
    """Leave what a process leaves that is killed while it runs a cell."""
    for file in ("results.csv", "cell.json"):
        (cell_folder(name) / file).unlink()


def test_a_killed_cell_is_resumed(trainer):
    run(config())
    kill("plain/other/seed0")
    result = run(config())
    assert len(trainer.cells) == 4
    assert trainer.resumed == ["out/cells/plain/other/seed0"]
    assert result.failures == {}
    times = result.results[result.results.measure == "seconds"]
    assert len(times) == 3, "nobody knows how long the first part took"


@pytest.mark.parametrize("file", ["cell.json", "results.csv"])
def test_a_cell_that_was_damaged_is_run_again_and_stops_no_other(trainer, file):
    before = run(config())
    damaged = cell_folder("plain/other/seed0") / file
    damaged.write_text(damaged.read_text()[:-9])
    with pytest.warns(UserWarning, match="the cell is run again"):
        after = run(config())
    assert trainer.resumed == ["out/cells/plain/other/seed0"]
    assert after.failures == {}
    one, other = (of.results[of.results.measure != "seconds"] for of in (before, after))
    assert one.value.tolist() == other.value.tolist()


def test_a_killed_cell_that_cannot_be_resumed_is_run_anew(trainer):
    run(config())
    kill("plain/other/seed0")
    trainer.fails["plain/other/seed0"] = ValueError("half a checkpoint")
    result = run(config())
    assert trainer.resumed == ["out/cells/plain/other/seed0"]
    assert trainer.cells[4:] == ["plain/other/seed0"]
    assert result.failures == {}
    log = Path("out/logs/plain/other/seed0.txt").read_text()
    assert "half a checkpoint" in log


def test_a_killed_cell_of_other_settings_is_run_anew(trainer):
    run(config())
    kill("plain/other/seed0")
    path = cell_folder("plain/other/seed0") / "config.yaml"
    stored = OmegaConf.load(path)
    stored.method.members = 7
    OmegaConf.save(stored, path)
    run(config())
    assert trainer.resumed == []
    assert trainer.cells[4:] == ["plain/other/seed0"]


def test_a_cell_killed_before_it_began_is_run_anew(trainer):
    cell_folder("plain/popl/seed0").mkdir(parents=True)
    Path("out/benchmark.json").write_text('{"suite": "mine"}')
    result = run(config())
    assert result.failures == {}
    assert trainer.cells == CELLS


def test_a_finished_cell_of_other_settings_is_an_error_before_anything_runs(trainer):
    run(config())
    Path("mine.yaml").write_text(SUITE.replace("mistake=0.1", "mistake=0.2"))
    with pytest.raises(ValueError, match=r"cell noisy/popl/seed0 was run with other settings"):
        run(config(seeds=2))
    assert len(trainer.cells) == 4


def test_a_failing_cell_stops_only_those_that_need_its_data(trainer):
    trainer.fails["noisy/popl/seed0"] = RuntimeError("a defect")
    trainer.fails["plain/other/seed0"] = ValueError("a mistake")
    result = run(config())
    assert set(result.failures) == {CELLS[1], CELLS[2], CELLS[3]}
    assert result.failures["noisy/popl/seed0"].startswith("RuntimeError: a defect (see out/logs/")
    assert result.failures["plain/other/seed0"].startswith("a mistake (see ")
    assert result.failures["noisy/other/seed0"] == "noisy/popl/seed0 failed, which it needs"
    assert "Traceback" in Path("out/logs/noisy/popl/seed0.txt").read_text()
    report = Path("out/report.md").read_text()
    assert "Missing cells: 3" in report
    assert "- plain/other/seed0: a mistake" in report
    again = run(config())
    assert again.failures == {}
    assert len(again.results[again.results.measure == "seconds"]) == 2, "two were resumed"


def test_one_cell_alone_makes_its_data_first(trainer):
    result = run(config(cell=3))
    assert trainer.cells == ["noisy/popl/seed0", "noisy/other/seed0"]
    assert set(result.results.scenario) == {"noisy"}
    assert not Path("out/results.csv").exists(), "others may be at work"
    run(config(cell=1))
    assert len(trainer.cells) == 2
    for index in (0, 2):
        run(config(cell=index))
    assert len(trainer.cells) == 4
    run(config())
    assert len(trainer.cells) == 4, "it only collects"
    assert Path("out/results.csv").is_file()


# From the shell


@pytest.fixture
def call(monkeypatch, capsys):
    def call(*overrides):
        monkeypatch.setattr(sys, "argv", ["popl-benchmark", *overrides])
        code = 0
        try:
            run_benchmark.cli()
        except SystemExit as leave:
            code = leave.code
        out, err = capsys.readouterr()
        return code, out + err

    return call


MINE = ("suite=mine.yaml", "seeds=1", "workers=0", "run_dir=out")


def test_the_command_prints_the_table(call, trainer):
    code, text = call(*MINE)
    assert code == 0, text
    assert "0.90" in text
    assert "everything is in out" in text


def test_the_folder_and_the_number_of_seeds_have_defaults(call, trainer):
    Path("mine.yaml").write_text(SUITE + "seeds: 2\n")
    code, text = call("suite=mine.yaml", "workers=0")
    assert code == 0, text
    assert len(trainer.cells) == 8
    assert Path("runs/benchmark-mine/report.md").is_file()


def test_failures_are_listed_and_the_exit_code_tells(call, trainer):
    trainer.fails["plain/other/seed0"] = ValueError("a mistake")
    code, text = call(*MINE)
    assert code == 2
    assert "error: 1 cells failed:\n  plain/other/seed0: a mistake (see" in text
    assert "Traceback" not in text
    assert "0.90" in text, "the others are shown"


def test_a_sweep_over_cells_takes_them_one_by_one(call, trainer):
    code, text = call("-m", *MINE, "cell=range(0,4)")
    assert code == 0, text
    assert sorted(trainer.cells) == sorted(CELLS)


def test_a_failing_cell_of_a_sweep_stops_no_other(call, trainer):
    trainer.fails["plain/popl/seed0"] = ValueError("a mistake")
    code, text = call("-m", *MINE, "cell=0,1,3")
    assert code == 2
    assert "a mistake" in text
    assert trainer.cells == ["plain/popl/seed0", "noisy/popl/seed0", "noisy/other/seed0"]


def test_interrupting(call, trainer):
    trainer.fails["plain/popl/seed0"] = KeyboardInterrupt()
    code, text = call(*MINE)
    assert code == 130
    assert "the same command goes on" in text


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["suite=two_dors"], ["unknown suite 'two_dors'", "Did you mean 'two_doors'", "smoke"]),
        (["suite=nowhere.yaml"], ["unknown suite 'nowhere.yaml'"]),
        (["seeds=0"], ["seeds must be at least 1, got 0"]),
        (["seeds=0", "-m"], ["seeds must be at least 1, got 0"]),
        (["seeds=many"], ["many", "seeds"]),
        (["cell=4"], ["cell must be from 0 to 3, got 4", "cells.csv"]),
        (["cell=-1"], ["cell must be from 0 to 3, got -1"]),
        (["workers=-1"], ["workers must be at least 0, got -1"]),
        (["sedes=3"], ["sedes"]),
        (["suite=bad.yaml"], ["scenarios.a: unknown key 'overides'. Did you mean 'overrides'"]),
        (["suite=odd.yaml"], ["cell a/popl/seed0 cannot be run", "method.membres"]),
        (
            ["suite=low.yaml"],
            ["cell a/popl/seed0 cannot be run", "method.members must be at least"],
        ),
    ],
    ids=lambda value: value[0] if "=" in value[0] else "",
)
def test_what_the_user_can_put_right(call, trainer, overrides, parts):
    Path("bad.yaml").write_text("methods: {popl: []}\nscenarios: {a: {overides: []}}\n")
    Path("odd.yaml").write_text("methods: {popl: [method.membres=3]}\nscenarios: {a: []}\n")
    Path("low.yaml").write_text("methods: {popl: [method.members=1]}\nscenarios: {a: []}\n")
    code, text = call(*MINE, *overrides)
    assert code == 2, text
    assert "Traceback" not in text
    for part in parts:
        assert part in text[text.index("error:") :]
    assert trainer.cells == []
    assert {path.suffix for path in Path().iterdir()} == {".yaml"}, "no folder is left behind"


def test_a_suite_must_be_named(call):
    code, text = call()
    assert code == 2
    assert "suite" in text


def test_a_folder_of_another_suite(call, trainer):
    assert call(*MINE)[0] == 0
    Path("other.yaml").write_text(SUITE)
    code, text = call(*MINE, "suite=other.yaml")
    assert code == 2
    assert "run_dir out holds suite 'mine', not 'other'; choose another run_dir" in text
