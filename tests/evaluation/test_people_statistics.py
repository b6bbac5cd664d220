"""Intervals over people, who gains and who is served worst."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from popl_rl.evaluation.people_statistics import (
    PERSON_COLUMNS,
    compare,
    paired_bootstrap,
    summarise_people,
)


@given(st.lists(st.floats(-1, 1), min_size=2, max_size=30))
def test_the_interval_holds_the_mean(values):
    mean, low, high = paired_bootstrap(np.array(values), samples=200)
    assert low - 1e-9 <= mean <= high + 1e-9
    assert min(values) - 1e-9 <= low
    assert high <= max(values) + 1e-9


def test_the_interval_is_near_the_normal_one():
    values = np.random.default_rng(0).normal(0.3, 1, 400)
    mean, low, high = paired_bootstrap(values)
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((mean - half, mean + half), abs=0.02)


def test_of_many_people_the_limit_of_the_bootstrap_is_taken():
    values = np.random.default_rng(0).exponential(size=5001)
    ends = [np.array(paired_bootstrap(values[:5000], seed=seed)) for seed in range(8)]
    error = np.std(ends, axis=0)[1:].mean()
    limit = np.array(paired_bootstrap(values))
    assert (limit == paired_bootstrap(values, seed=1)).all()
    assert np.abs(limit - np.mean(ends, axis=0)).max() < 2 * error


def test_one_person_has_no_interval():
    mean, low, high = paired_bootstrap(np.array([0.5]))
    assert mean == 0.5
    assert np.isnan([low, high]).all()
    assert np.isnan(paired_bootstrap(np.array([]))).all()


def test_who_gains_and_who_loses_by_hand():
    found = compare(np.array([1.0, 0.5, 0.2, 0.4]), np.array([0.5, 0.5, 0.4, 0.2]))
    assert found["gain"] == pytest.approx(0.125)
    assert (found["gain_share"], found["loss_share"]) == (0.5, 0.25)


def rows(method, choice, values, *, answers=5, groups=("", "")):
    return [
        (method, choice, 0, str(person), group, answers, accuracy, -0.5)
        for person, (accuracy, group) in enumerate(zip(values, groups, strict=True))
    ]


def test_rows_are_over_all_and_over_each_group():
    people = pd.DataFrame(
        [
            *rows("popl", "posterior", [0.9, 0.7], groups=("x", "y")),
            *rows("pooled_cpl", "", [0.6, 0.8], groups=("x", "y")),
        ],
        columns=PERSON_COLUMNS,
    )
    found = summarise_people(people, references=[("pooled_cpl", "")])
    value = found.set_index(["method", "group", "measure"])["value"]
    assert value["popl", "all", "accuracy@5"] == pytest.approx(0.8)
    assert value["popl", "all", "worst_decile@5"] == pytest.approx(0.7)
    assert value["popl", "all", "people@5"] == 2
    assert value["popl", "all", "gain_over_pooled_cpl@5"] == pytest.approx(0.1)
    assert value["popl", "all", "loss_over_pooled_cpl_share@5"] == 0.5
    assert value["popl", "x", "gain_over_pooled_cpl@5"] == pytest.approx(0.3)
    assert value["popl", "y", "gain_over_pooled_cpl@5"] == pytest.approx(-0.1)
    assert "gain_over_pooled_cpl@5" not in set(found[found.method == "pooled_cpl"].measure)
