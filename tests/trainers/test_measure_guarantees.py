"""What sets guarantee is counted in the cells of a benchmark, and drawn."""

import json
import shutil

import pandas as pd
import pytest

from popl_rl.experiments.guarantees import guarantee_rows
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


def test_rows_are_kept_and_drawn_again(rows, tmp_path):
    kept = tmp_path / "configs" / "results"
    kept.mkdir(parents=True)
    (tmp_path / ".assets").mkdir()
    other = rows.assign(scenario="ring_12")
    pd.concat([rows, other]).to_csv(kept / "guarantees.csv", index=False)
    assert main(["--root", str(tmp_path)]) == 0
    assert (tmp_path / ".assets" / "guarantees.png").stat().st_size > 1000


def test_what_cannot_be_counted_is_said(finished, tmp_path, capsys):
    assert main([str(tmp_path), "--root", str(tmp_path)]) == 2
    assert "no finished cells" in capsys.readouterr().err
    shutil.copytree(finished, tmp_path / "changed")
    cell = tmp_path / "changed" / "cells" / "three_groups" / "popl_2" / "seed0"
    text = (cell / "config.yaml").read_text().replace("cases: rater", "cases: preference")
    (cell / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match="was changed"):
        guarantee_rows(tmp_path / "changed")
