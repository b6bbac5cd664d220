import math

import pytest
import torch
from torch import nn

from popl_rl.acting import Rolling
from popl_rl.config import EnvConfig, EvaluationConfig, RatersConfig
from popl_rl.experiment import build_groups
from popl_rl.policies import PolicySpec
from popl_rl.policy_set import PolicySet
from popl_rl.population import Population
from popl_rl.results import Judge
from popl_rl.worlds import build_world

ENV = EnvConfig(
    factory="popl_rl.testing:tiny_env",
    options={"max_steps": 8},
    max_steps=8,
    success="next_state",
    door="next_state",
)
MEASURES = {"return", "recovery", "success", "accuracy", "best_accuracy"}


def walkers(*pulls):
    """A policy for each pull: log-odds of walking right."""
    networks = []
    for pull in pulls:
        network = nn.Sequential(nn.Linear(5, 2))
        network.load_state_dict(
            {"0.weight": torch.zeros(2, 5), "0.bias": torch.tensor([0.0, pull])}
        )
        networks.append(network)
    return PolicySet(Population(networks, PolicySpec(5, 2, True, ())))


@pytest.fixture
def judge(segments, bank):
    world = build_world(ENV)
    names = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]
    groups = build_groups(RatersConfig(groups=names, label="regret"), world)
    worth = torch.stack([group.worth(segments) for group in groups])
    config = EvaluationConfig(episodes=6, new_raters=4, answers=10, pairs=200)
    acting = Rolling(world, ENV, config, seed=0)
    return Judge(acting, ENV, config, groups, bank, worth, seed=0)


@pytest.fixture
def policies():
    """One that walks right, one that does anything, one that walks left."""
    return walkers(4.0, 0.0, -4.0)


@pytest.fixture
def baselines():
    """A pooled policy that does anything, and the groups' oracles."""
    return walkers(0.0, -4.0, 4.0)


def test_every_group_finds_its_own_policy(judge, policies, baselines):
    board = judge.score(policies, baselines)
    assert board.catered == {"likes_left": 2, "likes_right": 0}
    for group in ("likes_left", "likes_right"):
        assert board.value("popl", group, "recovery") == pytest.approx(1, abs=0.05)
        assert board.value("oracle", group, "recovery") == pytest.approx(1)
        assert board.value("random", group, "recovery") == pytest.approx(0)
        assert board.value("popl", group, "accuracy") > 0.75
        # The set's accuracy for a group is that of the member it was given; the pooled policy
        # finds all segments equal, and a tie is not right.
        assert board.value("cpl", group, "accuracy") == 0
        best, catered = (board.value("popl", group, m) for m in ("best_accuracy", "accuracy"))
        assert best >= catered


def test_rows_and_episodes_are_called_as_asked(judge, policies, baselines):
    board, other = judge.score(policies, baselines), judge.score(policies, baselines, label="em")
    assert (board.label, other.label) == ("popl", "em")
    assert set(other.results.method) == {"em", "em_lexicase", "cpl", "oracle", "random"}
    assert other.results.value.equals(board.results.value)
    assert ("em", "likes_left") in other.episodes
    assert other.catered == board.catered


def test_the_table_is_complete_and_tidy(judge, policies, baselines):
    results = judge.score(policies, baselines).results
    assert list(results.columns) == ["method", "group", "measure", "value"]
    assert not results.duplicated(["method", "group", "measure"]).any()
    methods = {"popl", "popl_lexicase", "cpl", "oracle"}
    assert set(results.method) == {*methods, "random"}
    for method in methods:
        for group in ("likes_left", "likes_right"):
            rows = results[(results.method == method) & (results.group == group)]
            assert set(rows.measure) >= MEASURES
    assert results.value.notna().all()


def test_returns_success_and_doors_by_hand(judge, baselines):
    """Walking left from cell s for 8 steps visits s - 1, ..., 0, 0 ...; that is what it is paid.

    likes_left pays 1 - cell / 4 for each step. "Success" is here to have been in a cell other than
    0, which the left walker is if it starts in cell 2, 3 or 4; the "door" 0 is reached by all.
    """
    board = judge.score(walkers(-30.0), baselines)
    start = board.episodes["popl", "likes_left"]["info", "state"][0, :, 0]
    cells = (start.unsqueeze(1) - torch.arange(1, 9)).clamp(min=0)
    expected = float((1 - cells / 4).sum(1).mean())
    assert board.value("popl", "likes_left", "return") == pytest.approx(expected)
    success = float((start >= 2).float().mean())
    assert board.value("popl", "likes_left", "success") == pytest.approx(success)
    assert board.value("popl", "likes_left", "next_state_0") == 1
    door = float((cells == 2).any(1).float().mean())
    assert board.value("popl", "likes_left", "next_state_2") == pytest.approx(door)


def test_a_set_of_one_gives_everyone_that_one(judge, baselines):
    board = judge.score(walkers(9.0), baselines)
    assert board.catered == {"likes_left": 0, "likes_right": 0}
    assert board.value("popl", "likes_right", "recovery") == pytest.approx(1, abs=0.05)
    assert board.value("popl", "likes_left", "recovery") < 0


def test_without_baselines_there_is_no_recovery(judge, policies):
    board = judge.score(policies, None)
    assert set(board.results.method) == {"popl", "popl_lexicase", "random"}
    for method in ("popl", "random"):
        assert math.isnan(board.value(method, "likes_left", "recovery"))
        assert math.isfinite(board.value(method, "likes_left", "return"))


def test_judging_is_reproducible(judge, policies, baselines):
    one, other = (judge.score(policies, baselines).results for _ in range(2))
    assert one.equals(other)


def test_episodes_for_the_pictures(judge, policies, baselines):
    episodes = judge.score(policies, baselines).episodes
    assert set(episodes) == {
        (method, group)
        for method in ("popl", "cpl", "oracle")
        for group in ("likes_left", "likes_right")
    }
    assert all(rolled.batch_size == (1, 6, 8) for rolled in episodes.values())
    assert float(episodes["popl", "likes_left"]["action"].float().mean()) < 0.1
    assert float(episodes["oracle", "likes_right"]["action"].float().mean()) > 0.9


def test_new_raters_do_not_depend_on_the_set(judge, policies, monkeypatch):
    """What a new rater is asked and says is the same whatever policies are judged."""
    seen = []

    def look(self, segments, answers, **_):
        seen.append((answers["pair"].tolist(), answers["answer"].tolist()))
        return cater(self, segments, answers)

    cater = PolicySet.cater
    monkeypatch.setattr(PolicySet, "cater", look)
    picks = judge.cater(policies, "posterior")
    assert picks.shape == (2, 4)
    judge.cater(walkers(1.0, 2.0), "lexicase")
    assert seen[:8] == seen[8:]
    assert len({str(answers) for answers in seen[:8]}) == 8


def test_a_snapshot_is_the_accuracy_by_name(judge, policies):
    accuracy = judge.accuracy(policies)
    assert accuracy.shape == (3, 2)
    snapshot = judge.snapshot(policies)
    assert snapshot == {
        f"{name}/{policy}": pytest.approx(float(accuracy[policy, index]))
        for index, name in enumerate(("likes_left", "likes_right"))
        for policy in range(3)
    }
    assert snapshot["likes_left/2"] > 0.75 > snapshot["likes_left/0"]
