import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from popl_rl.data.environments import make_world
from popl_rl.evaluation.acting import Rolling
from popl_rl.evaluation.diagnostics import alarm
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.measures import group_returns
from popl_rl.evaluation.protocol import EvaluationProtocol, MeasuredInfos
from popl_rl.evaluation.statistics import RESULT_COLUMNS, rows_of
from popl_rl.models.hypothesis_set import Catered
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.raters.groups import make_groups

INFOS = MeasuredInfos(success="next_state", door="next_state")
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
def evaluator(segments, bank):
    world = make_world("popl_rl.testing:tiny_env", options={"max_steps": 8})
    names = ["popl_rl.testing:likes_left", "popl_rl.testing:likes_right"]
    groups = make_groups(names, label="regret", table=world.table)
    segment_utility = torch.stack([group.segment_utility(segments) for group in groups])
    protocol = EvaluationProtocol(new_raters=4, answers=10, pairs=200)
    acting = Rolling(world, episodes=6, max_steps=8, seed=0)
    return Evaluator(acting, groups, bank, segment_utility, protocol=protocol, infos=INFOS, seed=0)


@pytest.fixture
def policies():
    """One that walks right, one that does anything, one that walks left."""
    return walkers(4.0, 0.0, -4.0)


@pytest.fixture
def baselines():
    """A pooled policy that does anything, and the groups' oracles."""
    return walkers(0.0, -4.0, 4.0)


def test_every_group_finds_its_own_policy(evaluator, policies, baselines):
    board = evaluator.score(policies, baselines)
    assert board.catered == {"likes_left": 2, "likes_right": 0}
    for group in ("likes_left", "likes_right"):
        assert board.value("popl", group, "recovery") == pytest.approx(1, abs=0.05)
        assert board.value("oracle", group, "recovery") == pytest.approx(1)
        assert board.value("random", group, "recovery") == pytest.approx(0)
        assert board.value("popl", group, "accuracy") > 0.75
        # The set's accuracy for a group is that of the member it was given; the pooled policy
        # finds all segments equal, and a tie is not right.
        assert board.value("pooled_cpl", group, "accuracy") == 0
        best, catered = (board.value("popl", group, m) for m in ("best_accuracy", "accuracy"))
        assert best >= catered


def test_rows_and_episodes_are_called_as_asked(evaluator, policies, baselines):
    board, other = (
        evaluator.score(policies, baselines),
        evaluator.score(policies, baselines, label="em"),
    )
    assert (board.label, other.label) == ("popl", "em")
    assert set(other.results.method) == {"em", "pooled_cpl", "oracle", "optimum", "random"}
    assert set(other.results.choice[other.results.method == "em"]) == {"", "posterior", "lexicase"}
    assert other.results.value.equals(board.results.value)
    assert ("em", "likes_left") in other.episodes
    assert other.catered == board.catered


def test_the_table_is_complete_and_tidy(evaluator, policies, baselines):
    results = evaluator.score(policies, baselines).results
    assert list(results.columns) == RESULT_COLUMNS
    assert not results.duplicated(RESULT_COLUMNS[:-1]).any()
    assert set(results.method) == {"popl", "pooled_cpl", "oracle", "optimum", "random"}
    assert set(results.choice[results.method != "popl"]) == {""}
    found = [("popl", "posterior"), ("popl", "lexicase"), ("pooled_cpl", ""), ("oracle", "")]
    for entry in found:
        for group in ("likes_left", "likes_right"):
            rows = rows_of(results[results.group == group], *entry)
            assert set(rows.measure) >= MEASURES
    assert results.value.notna().all()


def test_returns_success_and_doors_by_hand(evaluator, baselines):
    """Walking left from cell s for 8 steps visits s - 1, ..., 0, 0 ...; that is what it is paid.

    likes_left pays 1 - cell / 4 for each step. "Success" is here to have been in a cell other than
    0, which the left walker is if it starts in cell 2, 3 or 4; the "door" 0 is reached by all.
    """
    board = evaluator.score(walkers(-30.0), baselines)
    start = board.episodes["popl", "likes_left"]["info", "state"][0, :, 0]
    cells = (start.unsqueeze(1) - torch.arange(1, 9)).clamp(min=0)
    expected = float((1 - cells / 4).sum(1).mean())
    assert board.value("popl", "likes_left", "return") == pytest.approx(expected)
    success = float((start >= 2).float().mean())
    assert board.value("popl", "likes_left", "success") == pytest.approx(success)
    assert board.value("popl", "likes_left", "next_state_0") == 1
    door = float((cells == 2).any(1).float().mean())
    assert board.value("popl", "likes_left", "next_state_2") == pytest.approx(door)


def test_a_set_of_one_gives_everyone_that_one(evaluator, baselines):
    board = evaluator.score(walkers(9.0), baselines)
    assert board.catered == {"likes_left": 0, "likes_right": 0}
    assert board.value("popl", "likes_right", "recovery") == pytest.approx(1, abs=0.05)
    assert board.value("popl", "likes_left", "recovery") < 0


def test_without_baselines_there_is_no_recovery(evaluator, policies):
    board = evaluator.score(policies, None)
    assert set(board.results.method) == {"popl", "optimum", "random"}
    for method in ("popl", "random"):
        assert math.isnan(board.value(method, "likes_left", "recovery"))
        assert math.isfinite(board.value(method, "likes_left", "return"))


def test_greedy_acting_and_single_raters_beside_the_groups(evaluator, baselines):
    """A policy that leans to one side is the optimum when it acts greedily, not when sampled."""
    board = evaluator.score(walkers(1.0, -1.0), baselines)
    for group in ("likes_left", "likes_right"):
        assert board.value("popl", group, "greedy_share_of_optimum") == pytest.approx(1)
        assert board.value("popl", group, "share_of_optimum") < 0.9
    assert board.value("popl", "all", "worst_greedy_share_of_optimum") == pytest.approx(1)
    # Everybody is given the policy that leans to their side, so the quantile is the worst group's.
    worst = board.value("popl", "all", "worst_share_of_optimum")
    given = board.value("popl", "all", "rater_quantile_share_of_optimum")
    assert given == pytest.approx(worst)
    assert board.value("random", "all", "rater_quantile_share_of_optimum") == pytest.approx(0)


def test_judging_is_reproducible(evaluator, policies, baselines):
    one, other = (evaluator.score(policies, baselines).results for _ in range(2))
    assert one.equals(other)


def test_episodes_for_the_pictures(evaluator, policies, baselines):
    episodes = evaluator.score(policies, baselines).episodes
    assert set(episodes) == {
        (method, group)
        for method in ("popl", "pooled_cpl", "oracle")
        for group in ("likes_left", "likes_right")
    }
    assert all(rolled.batch_size == (1, 6, 8) for rolled in episodes.values())
    assert float(episodes["popl", "likes_left"]["action"].float().mean()) < 0.1
    assert float(episodes["oracle", "likes_right"]["action"].float().mean()) > 0.9


def test_new_raters_do_not_depend_on_the_set(evaluator, policies, monkeypatch):
    """What a new rater is asked and says is the same whatever policies are judged."""
    seen = []

    def look(self, segments, answers, **_):
        seen.append((answers["pair"].tolist(), answers["answer"].tolist()))
        return cater(self, segments, answers)

    cater = PolicySet.cater
    monkeypatch.setattr(PolicySet, "cater", look)
    picks = evaluator.cater(policies, "posterior")
    assert picks.shape == (2, 4)
    evaluator.cater(walkers(1.0, 2.0), "lexicase")
    assert seen[:8] == seen[8:]
    assert len({str(answers) for answers in seen[:8]}) == 8


def test_a_snapshot_is_the_accuracy_by_name(evaluator, policies):
    accuracy = evaluator.accuracy(policies)
    assert accuracy.shape == (3, 2)
    snapshot = evaluator.snapshot(policies)
    assert snapshot == {
        f"{name}/{policy}": pytest.approx(float(accuracy[policy, index]))
        for index, name in enumerate(("likes_left", "likes_right"))
        for policy in range(3)
    }
    assert snapshot["likes_left/2"] > 0.75 > snapshot["likes_left/0"]


@pytest.fixture
def curious(evaluator):
    """A judge who measures curves, of policies that always do the same."""
    acting = Rolling(evaluator.acting.world, episodes=6, max_steps=8, greedy=True, seed=0)
    return Evaluator(
        acting,
        evaluator.groups,
        evaluator.bank,
        evaluator.segment_utility,
        protocol=replace(evaluator.protocol, curve=[10, 1, 25]),
        infos=INFOS,
        seed=0,
    )


def values(board, method, group, choice=""):
    rows = rows_of(board.results[board.results.group == group], method, choice)
    return rows.set_index("measure").value.to_dict()


def test_fewer_answers_are_the_first_of_more(curious):
    for raters in curious.new_raters:
        assert [len(said) for said in raters] == [25] * 4
    asked = []

    class Spy:
        def cater(self, _, answers, **__):
            asked.append(answers["pair"].tolist())
            return Catered(0, torch.ones(1))

    for answers in (1, 10, None):
        curious.cater(Spy(), "posterior", answers=answers)
    one, ten, as_configured = asked[:8], asked[8:16], asked[16:]
    assert ten == as_configured
    assert one == [pairs[:1] for pairs in ten]
    assert ten == [said["pair"][:10].tolist() for raters in curious.new_raters for said in raters]


def test_curves_by_hand(curious, policies, baselines):
    """What is given to whom after one answer decides about both numbers at that point."""
    board = curious.score(policies, baselines)
    accuracy = curious.accuracy(policies)
    returns = group_returns(curious.acting(policies), curious.groups)
    low = group_returns(curious.acting(None), curious.groups)[0]
    high = group_returns(curious.acting(baselines)[1:], curious.groups).diagonal()
    for method in ("posterior", "lexicase"):
        picks = curious.cater(policies, method, answers=1)
        for index, group in enumerate(curious.groups):
            found = values(board, "popl", group.name, method)
            expected = float(accuracy[picks[index], index].mean())
            assert found["accuracy@1"] == pytest.approx(expected)
            mean = float(returns[picks[index], index].mean())
            expected = (mean - float(low[index])) / float(high[index] - low[index])
            assert found["recovery@1"] == pytest.approx(expected, abs=1e-5)
            # The headline is a point of the curve.
            assert found["accuracy@10"] == found["accuracy"]
            assert found["recovery@10"] == found["recovery"]
            assert {"accuracy@25", "recovery@25"} <= set(found)
            assert "accuracy@20" not in found


def test_curves_of_questions_that_were_chosen(curious, baselines):
    """Of two opposite walkers one well-chosen answer finds a rater's own."""
    board = curious.score(walkers(4.0, -4.0), baselines)
    for group in ("likes_left", "likes_right"):
        found = values(board, "popl", group, "information_gain")
        measures = {
            f"{name}@{answers}" for name in ("accuracy", "recovery") for answers in (1, 10, 25)
        }
        assert set(found) >= measures
        assert all("@" in measure for measure in found)
        best = board.value("popl", group, "best_accuracy", "posterior")
        assert found["accuracy@1"] == pytest.approx(best)
        assert found["recovery@1"] == pytest.approx(1, abs=0.05)


def test_members_are_rolled_once_and_no_more_than_allowed(curious, baselines, monkeypatch):
    """Members 0 and 2 are the most accurate. Point 25 needs member 3 besides, point 1 member 4."""
    policies = walkers(4.0, 0.0, -4.0, 3.0, -3.0)
    given = {None: 0, 10: 0, 25: 3, 1: 4}
    monkeypatch.setattr(
        curious, "cater", lambda *_, answers=None, **__: torch.full((2, 4), given[answers])
    )
    fair = policies.fair(curious.bank, curious.held_out[0])
    always = len({0, 2, fair})
    rolled, acting = [], curious.acting

    def watch(hypotheses):
        rolled.append(0 if hypotheses is None else len(hypotheses))
        return acting(hypotheses)

    monkeypatch.setattr(curious, "acting", watch)
    protocol = replace(curious.protocol, curve_members=always + 1)
    monkeypatch.setattr(curious, "protocol", protocol)
    board = curious.score(policies, baselines)
    assert rolled == [0, 3, always + 1], "random actions, baselines, and the set, each in one go"
    found = values(board, "popl", "likes_left", "posterior")
    assert {"recovery@10", "recovery@25"} <= set(found)
    assert "recovery@1" not in found
    assert "accuracy@1" in found, "which takes no rollouts"


def test_what_hindsight_could_have_given(evaluator, baselines):
    """Of a walker for each group and one that does anything, the walker is the best and the most
    accurate; of two that walk right, both are bad for who likes left."""
    board = evaluator.score(walkers(4.0, 0.0, -4.0), baselines)
    for group in ("likes_left", "likes_right"):
        for measure in ("best_recovery", "accurate_recovery"):
            assert board.value("popl", group, measure) == pytest.approx(1, abs=0.05)
    board = evaluator.score(walkers(4.0, 6.0), baselines)
    for measure in ("best_recovery", "accurate_recovery"):
        assert board.value("popl", "likes_left", measure) < 0
        assert board.value("popl", "likes_right", measure) == pytest.approx(1, abs=0.05)


def test_the_set_as_a_whole(evaluator, baselines):
    """A set for one group covers half of the groups, and its fair choice serves the other badly."""
    board = evaluator.score(walkers(9.0), baselines)
    found = values(board, "popl", "all")
    worst = board.value("popl", "likes_left", "recovery")
    given = values(board, "popl", "all", "posterior")
    assert given["worst_recovery"] == worst < 0
    assert given["coverage"] == 0.5
    assert found["fair_recovery"] == pytest.approx(worst, abs=1e-6)
    assert found["distinct"] == found["favourite_share"] == 1
    assert found["effective"] == pytest.approx(1)
    assert found["gain"] == found["gain_error"] == 0
    assert found["further_accuracy"] == found["one_for_all_accuracy"]
    assert 0 <= found["fair_worst_rater"] <= found["fair_quantile"] < 0.5
    oracle = values(board, "oracle", "all")
    assert (oracle["worst_recovery"], oracle["coverage"]) == (1, 1)
    assert values(board, "pooled_cpl", "all")["coverage"] == 0


def test_shares_of_the_optimum_by_hand(evaluator, baselines):
    """Walkers that hardly ever err are at the optimum; the pooled policy is random here."""
    board = evaluator.score(walkers(30.0, -30.0), baselines)
    for group in ("likes_left", "likes_right"):
        for measure in ("share_of_optimum", "best_share_of_optimum", "accurate_share_of_optimum"):
            assert board.value("popl", group, measure) == pytest.approx(1)
        assert board.value("pooled_cpl", group, "share_of_optimum") == pytest.approx(0)
        assert board.value("random", group, "share_of_optimum") == 0
        assert 0.9 < board.value("oracle", group, "share_of_optimum") < 1
    lopsided = evaluator.score(walkers(30.0), baselines)
    for measure in ("worst_share_of_optimum", "fair_share_of_optimum"):
        assert lopsided.value("popl", "all", measure) == pytest.approx(-1)
    rows = board.results[board.results.measure == "worst_share_of_optimum"]
    found = set(zip(rows.method, rows.choice, strict=True))
    catered = {("popl", "posterior"), ("popl", "lexicase")}
    others = ("pooled_cpl", "oracle", "optimum", "random")
    assert found == catered | {(name, "") for name in others}


def test_the_alarm_hears_a_collapse_and_no_healthy_set(evaluator, policies, baselines):
    """Two ways to serve only one group, and a set that serves both."""
    assert alarm(evaluator.score(policies, baselines).results) is None
    for pulls in ([9.0], [4.0, 4.1, 3.9]):
        assert "tells nobody apart" in alarm(evaluator.score(walkers(*pulls), baselines).results)


def test_the_fair_choice_is_measured_on_others_than_chose_it(evaluator, policies):
    choosing, measuring = evaluator.held_out
    assert len(choosing) == len(measuring) == 5 * 4 * 50
    assert not torch.equal(choosing["pair"], measuring["pair"])
    board = evaluator.score(policies, None)
    scores = evaluator.scores(policies)[policies.fair(evaluator.bank, choosing)]
    chosen = measuring["pair"].gather(1, measuring["answer"].unsqueeze(1)).squeeze(1)
    other = measuring["pair"].gather(1, 1 - measuring["answer"].unsqueeze(1)).squeeze(1)
    accuracy = (scores[chosen] > scores[other]).float().view(20, 50).mean(1)
    assert board.value("popl", "all", "fair_worst_rater") == pytest.approx(float(accuracy.min()))


def test_panels_have_the_shares_of_the_groups(evaluator):
    skewed = Evaluator(
        evaluator.acting,
        evaluator.groups,
        evaluator.bank,
        evaluator.segment_utility,
        protocol=evaluator.protocol,
        infos=INFOS,
        shares=[1.0, 0.0],
        seed=0,
    )
    held_out = skewed.held_out[0]
    chosen = held_out["pair"].gather(1, held_out["answer"].unsqueeze(1)).squeeze(1)
    other = held_out["pair"].gather(1, 1 - held_out["answer"].unsqueeze(1)).squeeze(1)
    assert bool((evaluator.segment_utility[0, chosen] > evaluator.segment_utility[0, other]).all())
