"""What sets guarantee is counted in the cells of a benchmark, and drawn."""

import json
import shutil

import pandas as pd
import pytest

from popl_rl.experiments.guarantees import guarantee_rows
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.plotting.guarantee_plots import guarantee_curves
from popl_rl.trainers import train_popl
from popl_rl.trainers.measure_guarantees import main


@pytest.fixture(scope="module")
def finished(config_of, tiny, tmp_path_factory):
    """Folder of a benchmark with the cells of two sizes of a population."""
    folder = tmp_path_factory.mktemp("benchmark")
    (folder / "benchmark.json").write_text(json.dumps({"suite": "guarantees"}))
    for size in (2, 6):
        train_popl.run(
            config_of(
                *tiny[1:],
                "env=hidden_utility",
                "raters=cycle",
                "raters.count=12",
                "evaluation.curve=[]",
                "evaluation.history=0",
                "evaluation.reward_baselines=false",
                f"method.members={size}",
                f"run_dir={folder / 'cells' / 'three_groups' / f'popl_{size}' / 'seed0'}",
            )
        )
    return folder


@pytest.fixture(scope="module")
def rows(finished):
    return guarantee_rows(finished)


def test_undominated_members_are_among_those_returned(rows):
    assert set(rows["scenario"]) == {"three_groups"}
    wide = rows.pivot_table(index="method", columns="measure", values="value")
    assert wide["population"].to_dict() == {"popl_2": 2, "popl_6": 6}
    assert (wide["members"] <= wide["population"]).all()
    for measure in ("undominated_training", "undominated", "undominated_beside_oracles"):
        assert (wide[measure] <= wide["members"]).all()
    # Of finitely many one is always undominated, unless by an oracle.
    assert (wide[["undominated_training", "undominated"]] >= 1).all(axis=None)
    assert wide[["best_accuracy", "oracle_accuracy"]].stack().between(0, 1).all()


def test_a_figure_is_drawn_from_rows(rows):
    fig = guarantee_curves(rows, {"three_groups": "three groups"})
    counts, accuracies = fig.axes
    assert counts.get_title() == "three groups"
    assert [len(ax.get_lines()) for ax in (counts, accuracies)] == [4, 2]
    returned = rows[rows["measure"] == "members"].sort_values("method")["value"]
    assert list(counts.get_lines()[0].get_ydata()) == list(returned)
    with pytest.raises(ValueError, match="ring_12"):
        guarantee_curves(rows, {"ring_12": "12 groups"})


def test_rows_are_kept_and_drawn_again(finished, rows, tmp_path):
    benchmark = tmp_path / "benchmark"
    shutil.copytree(finished, benchmark)
    shutil.copytree(benchmark / "cells/three_groups/popl_2", benchmark / "cells/ring_12/popl_2")
    (tmp_path / "configs" / "results").mkdir(parents=True)
    (tmp_path / ".assets").mkdir()
    figure = tmp_path / ".assets" / "guarantees.png"
    assert main([str(benchmark), "--root", str(tmp_path)]) == 0
    kept = pd.read_csv(tmp_path / "configs/results/guarantees.csv", keep_default_na=False)
    copied = rows[rows["method"] == "popl_2"].assign(scenario="ring_12")
    expected = pd.concat([copied, rows], ignore_index=True)
    pd.testing.assert_frame_equal(kept, expected, rtol=0, atol=1e-4)
    drawn = figure.read_bytes()
    assert len(drawn) > 1000
    figure.unlink()
    assert main(["--root", str(tmp_path)]) == 0
    assert len(figure.read_bytes()) == len(drawn)


def test_what_cannot_be_counted_is_said(finished, tmp_path, capsys, monkeypatch):
    assert main([str(tmp_path), "--root", str(tmp_path)]) == 2
    assert "no finished cells" in capsys.readouterr().err

    def without_ids(run_dir):
        config = load_run_config(run_dir)
        config.method.cases = "preference"
        return config

    monkeypatch.setattr("popl_rl.experiments.guarantees.load_run_config", without_ids)
    with pytest.raises(ValueError, match=r"popl_2/seed0 .*cases='preference', expected 'rater'"):
        guarantee_rows(finished)
