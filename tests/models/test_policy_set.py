import json
import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.keys import Answer
from popl_rl.manifest import sealed
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population
from popl_rl.models.scoring import segment_scores

FIRST, SECOND, TIE, SKIP = (int(answer) for answer in Answer)


def linear_policies(*biases, discrete=True):
    """Policies of one observation that is always 1, and of nothing but the given biases."""
    networks = []
    for bias in biases:
        network = nn.Sequential(nn.Linear(1, len(bias)))
        network.load_state_dict(
            {"0.weight": torch.zeros(len(bias), 1), "0.bias": torch.tensor(bias)}
        )
        networks.append(network)
    return Population(networks, PolicySpec(1, len(biases[0]), discrete, ()))


@pytest.fixture
def two():
    """Policy 0 takes action 0 with probability 3/4, policy 1 with 1/4; scores with alpha = 1."""
    return PolicySet(linear_policies([math.log(3), 0.0], [0.0, math.log(3)]), alpha=1.0)


@pytest.fixture
def steps():
    """Two segments of one step: action 0, action 1."""
    return TensorDict({"observation": torch.ones(2, 1, 1), "action": torch.tensor([[0], [1]])}, [2])


def answers(*replies, raters=None):
    """Answers about segment 0 (shown first) against segment 1."""
    count = len(replies)
    data = {"pair": torch.tensor([[0, 1]] * count), "answer": torch.tensor(replies)}
    if raters is not None:
        data["rater"] = torch.tensor(raters)
    return TensorDict(data, [count])


@pytest.mark.parametrize(
    ("mistake", "expected"), [(0.0, [0.9, 0.1]), (0.1, [0.49 / 0.58, 0.09 / 0.58])]
)
def test_belief_by_hand(two, steps, mistake, expected):
    """The rater prefers segment 0 twice. Margins are ln(3/4) - ln(1/4) = ln 3 and -ln 3.

    sigmoid(ln 3) = 3/4, so without mistakes the answers have probability (3/4)^2 and (1/4)^2:
    9/10 against 1/10. With mistakes in one of ten, 0.9 * 3/4 + 0.1 * 1/4 = 0.7 and 0.3: 0.49
    against 0.09. A tie and a skip say nothing.
    """
    choice = two.cater(steps, answers(FIRST, TIE, FIRST, SKIP), mistake=mistake)
    torch.testing.assert_close(choice.weights, torch.tensor(expected))
    assert choice.member == 0
    assert two.cater(steps, answers(SECOND), mistake=mistake).member == 1


def test_belief_uses_the_sets_own_scale(steps):
    """alpha = 1/2 halves the margin: sigmoid(ln(3) / 2) = sqrt(3) / (1 + sqrt(3))."""
    policies = PolicySet(linear_policies([math.log(3), 0.0], [0.0, 0.0]), alpha=0.5)
    one = 3**0.5 / (1 + 3**0.5)
    weights = policies.cater(steps, answers(FIRST), mistake=0.0).weights
    torch.testing.assert_close(weights, torch.tensor([one, 0.5]) / (one + 0.5))


@pytest.mark.parametrize("method", ["posterior", "lexicase"])
def test_scores_that_are_known_are_not_worked_out(two, steps, method, monkeypatch):
    said = answers(FIRST, TIE, SECOND)
    scores = segment_scores(two.population, SegmentBank.from_segments(steps), alpha=two.alpha)

    def choice(**known):
        generator = torch.Generator().manual_seed(0)
        return two.cater(steps, said, method=method, generator=generator, **known)

    expected = choice()
    monkeypatch.setattr(PolicySet, "margins", None)
    found = choice(scores=scores)
    assert found.member == expected.member
    torch.testing.assert_close(found.weights, expected.weights)


def test_belief_survives_impossible_answers(steps):
    """Policies that are sure of the contrary of an answer still get finite weights."""
    policies = PolicySet(linear_policies([-500.0, 500.0], [-400.0, 600.0]))
    weights = policies.cater(steps, answers(FIRST, FIRST), mistake=0.0).weights
    torch.testing.assert_close(weights, torch.tensor([0.5, 0.5]))


def test_segments_may_be_a_bank(two, steps):
    bank = SegmentBank.from_segments(steps)
    one, other = two.cater(steps, answers(FIRST)), two.cater(bank, answers(FIRST))
    assert torch.equal(one.weights, other.weights)


def test_lexicase_catering_by_hand(two, steps, generator):
    """Policy 0 passes the answer, policy 1 does not."""
    choice = two.cater(steps, answers(FIRST, FIRST), method="lexicase", generator=generator)
    assert choice.member == 0
    assert choice.weights.tolist() == [1, 0]
    picks = {
        two.cater(steps, answers(FIRST, SECOND), method="lexicase", generator=generator).member
        for _ in range(20)
    }
    assert picks == {0, 1}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mistake": 0.5}, r"mistake must be in \[0, 0.5\), got 0.5"),
        ({"mistake": -0.1}, r"mistake must be in \[0, 0.5\), got -0.1"),
        ({"method": "vote"}, "method must be 'posterior' or 'lexicase', got 'vote'"),
        ({"method": "lexicase"}, "generator must be given for lexicase catering"),
    ],
)
def test_catering_refuses(two, steps, arguments, message):
    with pytest.raises(ValueError, match=message):
        two.cater(steps, answers(FIRST), **arguments)


def test_catering_needs_a_strict_answer(two, steps):
    with pytest.raises(ValueError, match="preferences must hold a strict answer, got 2 ties"):
        two.cater(steps, answers(TIE, SKIP))


def test_somebody_who_has_said_nothing_gets_the_fair_choice(two, steps, tmp_path):
    nothing = answers()
    with pytest.raises(ValueError, match=r"fair_member is None.*fair\(segments, preferences\)"):
        two.cater(steps, nothing)
    two.fair_member = two.fair(steps, answers(SECOND, SECOND, raters=[0, 1]))
    assert two.fair_member == 1
    for one in (two, two.subset([1])):
        choice = one.cater(steps, nothing)
        assert choice.member == len(one) - 1
        assert choice.weights.tolist() == [1 / len(one)] * len(one)
    two.save(tmp_path / "set")
    assert PolicySet.load(tmp_path / "set").fair_member == 1


@pytest.mark.parametrize(("quantile", "fairest"), [(0.1, 1), (0.0, 1), (0.5, 0), (1.0, 0)])
def test_fairness_by_hand(monkeypatch, two, steps, quantile, fairest):
    """Four raters with two answers each.

    Policy 0 is right about raters 0-2 and wrong about rater 3: of the accuracies 0, 1, 1, 1 the
    10 % quantile lies at 0.1 * 3 = 0.3 between the first two, which is 0.3. Policy 1 is right about
    one answer of each: every quantile is 1/2. The medians are 1 and 1/2.
    """
    margin = torch.tensor([[1.0] * 6 + [-1.0] * 2, [1.0, -1.0] * 4])
    monkeypatch.setattr("popl_rl.models.scoring.margins_of", lambda *_: margin)
    raters = [0, 0, 1, 1, 2, 2, 3, 3]
    assert two.fair(steps, answers(*[FIRST] * 8, raters=raters), quantile=quantile) == fairest


@pytest.mark.parametrize("quantile", [-0.1, 1.1, math.nan])
def test_fairness_refuses(two, steps, quantile):
    with pytest.raises(ValueError, match=rf"quantile must be in \[0, 1\], got {quantile}"):
        two.fair(steps, answers(FIRST, raters=[0]), quantile=quantile)


def test_fairness_needs_strict_answers_with_raters(two, steps):
    with pytest.raises(ValueError, match="preferences must hold a strict answer"):
        two.fair(steps, answers(TIE, raters=[0]))
    with pytest.raises(ValueError, match="preferences must hold 'rater'"):
        two.fair(steps, answers(FIRST))


@pytest.mark.parametrize(
    ("signs", "expected"),
    [
        ([[1, 1, 1, 1], [-1, -1, -1, -1]], 2.0),
        ([[1, -1, 1, 1], [1, -1, 1, 1]], 1.0),
        ([[1, 1, 1, 1], [1, 1, -1, -1]], 2.0),
        ([[1, 1, 1, 1], [1, 1, 1, -1]], 4 / 3),
        ([[1, 1, 1, 1], [1, 1, 1, 1], [-1, -1, -1, -1]], 9 / 5),
    ],
)
def test_effective_number_by_hand(monkeypatch, steps, signs, expected):
    """1 / mean of max(0, 2 agreement - 1) over all ordered pairs, oneself included.

    Opposite: mean (1 + 1 + 0 + 0) / 4. Equal: 1. Agreement 1/2 is chance: as opposite. Agreement
    3/4: similarity 1/2, mean (1 + 1 + 1/2 + 1/2) / 4. Two alike and one opposite: (3 + 2) / 9.
    """
    margin = torch.tensor(signs, dtype=torch.float)
    monkeypatch.setattr("popl_rl.models.hypothesis_set.margins_of", lambda *_: margin)
    policies = PolicySet(linear_policies(*[[0.0, 0.0]] * len(signs)))
    first = torch.zeros(4, dtype=torch.long)
    comparisons = Comparisons(first, first + 1, first, 1)
    number = policies.effective_number(SegmentBank.from_segments(steps), comparisons)
    assert number == pytest.approx(expected)


def test_distinct_members_by_hand(monkeypatch, bank, comparisons, generator):
    """Passes of the four members: (yes, no), (yes, no), (no, yes), (yes, no); 0 and 2 stay."""
    margin = torch.tensor([[1.0, -1.0], [1.0, 0.0], [-1.0, 1.0], [2.0, -0.5]])
    monkeypatch.setattr("popl_rl.models.hypothesis_set.margins_of", lambda *_: margin)
    population = Population.create(PolicySpec(5, 2, True, ()), 4, generator=generator)
    policies = PolicySet(population, alpha=0.3, discount=0.9).distinct(bank, comparisons)
    assert policies.origin == [0, 2]
    assert len(policies) == 2
    assert (policies.alpha, policies.discount) == (0.3, 0.9)
    observation = torch.eye(5)
    assert torch.equal(policies.population(observation), population(observation)[[0, 2]])
    assert policies.subset([1]).origin == [2]


def test_actions_of_one_and_of_all(two, generator):
    observation = torch.ones(3, 1)
    assert two.act(observation, greedy=True).tolist() == [[0, 0, 0], [1, 1, 1]]
    assert two.act(observation, member=1, greedy=True).tolist() == [1, 1, 1]
    assert two.act(observation[0], greedy=True).tolist() == [0, 1]
    assert two.act(observation[0], member=1, greedy=True).item() == 1
    each_its_own = torch.ones(2, 3, 1)
    assert two.act(each_its_own, greedy=True).tolist() == [[0, 0, 0], [1, 1, 1]]
    sampled = two.act(torch.ones(2000, 1), generator=generator)
    assert sampled.shape == (2, 2000)
    # Action 1 with probability 1/4 and 3/4, to four standard deviations.
    torch.testing.assert_close(
        sampled.float().mean(1), torch.tensor([0.25, 0.75]), atol=0.04, rtol=0
    )
    assert two.act(torch.ones(1), member=0, generator=generator).shape == ()


def test_continuous_policies_give_their_mean():
    policies = PolicySet(linear_policies([0.5, -2.0], [3.0, 1.0], discrete=False))
    assert policies.act(torch.ones(1, 1)).tolist() == [[[0.5, -2.0]], [[3.0, 1.0]]]
    assert policies.act(torch.ones(1)).tolist() == [[0.5, -2.0], [3.0, 1.0]]
    assert policies.act(torch.ones(1), member=1, greedy=True).tolist() == [3.0, 1.0]


def test_acting_refuses(two):
    with pytest.raises(ValueError, match="generator must be given to sample actions; or pass gree"):
        two.act(torch.ones(1))
    for member in (-1, 2):
        with pytest.raises(IndexError, match=rf"member must be in 0\.\.1, got {member}"):
            two.act(torch.ones(1), member=member, greedy=True)


def test_an_actor_is_one_of_the_policies(two):
    actor = two.actor(1)
    step = TensorDict({"observation": torch.ones(4, 1)}, [4])
    probabilities = actor.get_dist(step).probs.detach()
    torch.testing.assert_close(probabilities, torch.tensor([[0.25, 0.75]] * 4))


def test_actions_are_those_of_the_environment(two, generator, tmp_path):
    """Of Discrete(2, start=7), also after saving; of sets without a start they begin with 0."""
    networks = [two.population.network(member) for member in (0, 1)]
    policies = PolicySet(Population(networks, PolicySpec(1, 2, True, (), first_action=7)))
    batch = torch.ones(50, 1)
    policies.save(tmp_path / "later")
    for found in (policies, PolicySet.load(tmp_path / "later"), policies.subset([0, 1])):
        assert found.act(torch.ones(1), greedy=True).tolist() == [7, 8]
        drawn = found.act(batch, member=0, generator=generator)
        assert drawn.unique().tolist() == [7, 8]
        assert found.actor(1)(TensorDict({"observation": batch}, [50]))["action"].unique() == 8
    about = tmp_path / "later" / "policy_set.json"
    text = json.loads(about.read_text())
    assert text["spec"].pop("first_action") == 7
    del text["seal"]
    about.write_text(json.dumps(sealed(text)))
    old = PolicySet.load(tmp_path / "later")
    assert old.act(torch.ones(1), greedy=True).tolist() == [0, 1]


def saved_set(path, *, discrete=True, evolve="head", hidden=(4, 3)):
    generator = torch.Generator().manual_seed(3)
    spec = PolicySpec(3, 2, discrete, hidden, 0.3)
    population = Population.create(spec, 5, evolve=evolve, generator=generator)
    policies = PolicySet(population, alpha=0.1, discount=0.97).subset([4, 0, 2])
    policies.save(path)
    return policies


@pytest.mark.parametrize("discrete", [True, False])
@pytest.mark.parametrize("evolve", ["all", "head"])
@pytest.mark.parametrize("hidden", [(), (4, 3)])
def test_a_saved_set_comes_back_to_the_bit(tmp_path, discrete, evolve, hidden):
    path = tmp_path / "new" / "policies"
    policies = saved_set(path, discrete=discrete, evolve=evolve, hidden=hidden)
    loaded = PolicySet.load(str(path))
    assert loaded.population.spec == policies.population.spec
    assert loaded.population.evolve == evolve
    assert (loaded.alpha, loaded.discount, loaded.origin) == (0.1, 0.97, [4, 0, 2])
    one, other = policies.population.state_dict(), loaded.population.state_dict()
    assert list(one) == list(other)
    assert all(torch.equal(one[name], other[name]) for name in one)
    observation = torch.randn(6, 3)
    assert torch.equal(policies.population(observation), loaded.population(observation))
    assert [entry.name for entry in path.parent.iterdir()] == ["policies"]


def test_a_loaded_set_scores_alike(tmp_path, bank, comparisons, generator):
    population = Population.create(PolicySpec(5, 2, True, (4,)), 3, generator=generator)
    PolicySet(population).save(tmp_path / "set")
    loaded = PolicySet.load(tmp_path / "set")
    assert torch.equal(segment_scores(loaded.population, bank), segment_scores(population, bank))


def test_nothing_is_overwritten(tmp_path, two):
    two.save(tmp_path / "set")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(FileExistsError, match="set exists; remove it or choose another path"):
        two.save(tmp_path / "set")
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


@pytest.mark.parametrize("failing", ["save_tensordict", "write_json"])
def test_a_failed_save_leaves_nothing_behind(tmp_path, monkeypatch, two, failing):
    def fail(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(f"popl_rl.models.set_files.{failing}", fail)
    with pytest.raises(OSError, match="No space left"):
        two.save(tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_no_set_at_all(tmp_path):
    message = "no policy set at .*set: expected the folder 'policies' of a finished run"
    with pytest.raises(FileNotFoundError, match=message):
        PolicySet.load(tmp_path / "set")
    (tmp_path / "set").mkdir()
    with pytest.raises(FileNotFoundError, match=message):
        PolicySet.load(tmp_path / "set")
