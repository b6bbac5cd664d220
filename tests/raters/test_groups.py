import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from popl_rl.data.tables import Table
from popl_rl.keys import Answer
from popl_rl.raters.groups import RaterGroup, make_groups
from popl_rl.raters.people import Raters
from popl_rl.raters.response import Response

FIRST, SECOND, TIE, SKIP = (int(answer) for answer in Answer)


def by_reward(segments):
    return segments["reward"]


def by_minus_reward(segments):
    return -segments["reward"]


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def segments():
    """Three segments of three steps in a world of two states."""
    return TensorDict(
        {
            "observation": torch.zeros(3, 3, 1),
            "action": torch.tensor([[0, 0, 1], [1, 1, 1], [1, 0, 0]]),
            "reward": torch.tensor([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0], [0.0, 0.0, 5.0]]),
            "info": {"state": torch.tensor([[0, 0, 0], [0, 1, 1], [0, 1, 1]])},
        },
        batch_size=[3, 3],
    )


@pytest.fixture
def table():
    """Action 1 leads from state 0 to 1 for 1; in state 1 both actions end, action 1 for 2."""
    steps = TensorDict(
        {
            "observation": torch.zeros(2, 2, 1),
            "action": torch.arange(2).repeat(2, 1),
            "reward": torch.tensor([[0.0, 1.0], [0.0, 2.0]]),
            "info": {"state": torch.arange(2).unsqueeze(1).repeat(1, 2)},
        },
        batch_size=[2, 2],
    )
    terminal = torch.tensor([[False, False], [True, True]])
    return Table(steps, torch.tensor([[0, 1], [1, 1]]), terminal, torch.tensor([1.0, 0.0]))


def test_a_greedy_rater_by_hand(generator):
    sums = torch.tensor([[1.0, 2.0], [2.0, 1.0], [3.0, 3.0], [3.0, 3.0 + 1e-7], [0.0, 1e-5]])
    expected = [SECOND, FIRST, TIE, TIE, SECOND]
    assert Response().answer(sums, generator).tolist() == expected


def test_order_of_skip_and_tie_by_hand(generator):
    response = Response(tie=1.0, skip=2.0, mistake=1.0)
    sums = torch.tensor([[2.0, 1.5], [2.0, 2.5], [2.0, 3.0], [2.0, 3.5], [4.0, 1.0]])
    # Both at most 2; nearly equal; exactly 1 apart; mistaken; mistaken.
    expected = [SKIP, TIE, TIE, FIRST, SECOND]
    assert response.answer(sums, generator).tolist() == expected


def test_equal_up_to_rounding_is_relative_for_large_sums(generator):
    large = torch.tensor([[1000.0, 1000.0005], [1000.0, 1000.002]])
    assert Response().answer(large, generator).tolist() == [TIE, SECOND]


@pytest.mark.parametrize(
    ("response", "gap", "probability"),
    [
        (Response(rationality=1.0), 1.0, 1 / (1 + math.exp(-1))),
        (Response(rationality=2.0), -0.5, 1 / (1 + math.exp(1))),
        (Response(rationality=0.0), 5.0, 0.5),
        (Response(mistake=0.1), 1.0, 0.9),
        (Response(mistake=0.1), -1.0, 0.1),
        (Response(rationality=1.0, mistake=0.2), 1.0, 0.8 * 0.7310586 + 0.2 * 0.2689414),
    ],
)
def test_shares_of_answers_are_those_of_the_model(response, gap, probability, generator):
    number = 20_000
    sums = torch.tensor([[0.5, 0.5 + gap]]).repeat(number, 1)
    share = (response.answer(sums, generator) == SECOND).double().mean().item()
    error = math.sqrt(probability * (1 - probability) / number)
    assert share == pytest.approx(probability, abs=4 * error)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10_000),
    st.sampled_from(
        [Response(), Response(tie=0.5), Response(skip=0.0), Response(tie=0.3, skip=-0.2)]
    ),
)
def test_swapping_the_segments_mirrors_a_greedy_answer(seed, response):
    generator = torch.Generator().manual_seed(seed)
    sums = torch.randn(20, 2, generator=generator)
    mirror = torch.tensor([SECOND, FIRST, TIE, SKIP])
    answers = response.answer(sums, generator)
    assert torch.equal(response.answer(sums.flip(1), generator), mirror[answers])


def test_answers_repeat_with_the_seed_and_differ_without():
    sums = torch.zeros(200, 2) + torch.tensor([0.0, 0.1])
    response = Response(rationality=1.0)
    answers = [
        response.answer(sums, torch.Generator().manual_seed(seed)).tolist() for seed in (3, 3, 4)
    ]
    assert answers[0] == answers[1] != answers[2]


def test_no_pairs_get_no_answers(generator):
    assert Response().answer(torch.zeros(0, 2), generator).shape == (0,)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rationality": -1.0}, "rationality must be at least 0 .inf is greedy., got -1"),
        ({"rationality": math.nan}, "rationality must be"),
        ({"mistake": 1.2}, "mistake must be a probability"),
        ({"myopia": 0.0}, "myopia must be in"),
        ({"myopia": 1.1}, "myopia must be in"),
        ({"tie": -0.1}, "tie must be finite and at least 0"),
        ({"tie": math.inf}, "tie must be finite"),
        ({"skip": math.nan}, "skip must be finite, or None"),
    ],
)
def test_bad_responses(values, message):
    with pytest.raises(ValueError, match=message):
        Response(**values)


def test_bad_sums(generator):
    with pytest.raises(ValueError, match=r"shape \[pairs, 2\], got \[3\]"):
        Response().answer(torch.zeros(3), generator)
    with pytest.raises(ValueError, match="sums must be finite"):
        Response().answer(torch.tensor([[0.0, math.nan]]), generator)


def test_worth_by_return_is_the_myopic_sum(segments):
    (group,) = make_groups([by_reward], label="return", response=Response(myopia=0.5))
    torch.testing.assert_close(group.perceived_utility(segments), segments["reward"])
    # 1/4 + 2/2 + 3, and so on.
    torch.testing.assert_close(group.segment_utility(segments), torch.tensor([4.25, 2.75, 5.0]))


def test_worth_by_regret_is_the_sum_of_advantages(segments, table):
    """With discount 0.5: V(1) = 2, V(0) = 1 + 1 = 2, so A(0, 0) = 1 - 2 and A(1, 0) = 0 - 2."""
    (group,) = make_groups([by_reward], table=table, discount=0.5)
    assert group.advantages is not None
    torch.testing.assert_close(
        group.advantages.float(), torch.tensor([[-1.0, 0.0], [-2.0, 0.0]]), check_dtype=False
    )
    torch.testing.assert_close(group.segment_utility(segments), torch.tensor([-2.0, 0.0, -4.0]))


def test_regret_reads_states_that_are_stored_as_floats(segments, table):
    (group,) = make_groups([by_reward], table=table)
    floats = segments.clone().set(("info", "state"), segments["info", "state"].float())
    torch.testing.assert_close(group.segment_utility(floats), group.segment_utility(segments))


def test_steps_in_another_order_are_worth_the_same(generator):
    """Float32 sums of 500 tenths differ with their order by more than a tie allows."""
    steps = torch.full((2, 500), 0.1)
    steps[0, :100], steps[1, 400:] = 700.0, 700.0
    segments = TensorDict({"reward": steps}, batch_size=steps.shape)
    (group,) = make_groups([by_reward], label="return")
    assert group.segment_utility(segments)[0] == group.segment_utility(segments)[1]


def test_names_of_groups(table):
    groups = make_groups(["upper", "popl_rl.envs.two_doors:lower", by_reward], label="return")
    assert [group.name for group in groups] == ["upper", "lower", "by_reward"]


def test_responses_of_groups():
    hasty, careful = Response(mistake=0.3), Response()
    groups = make_groups([by_reward, by_minus_reward], label="return", response=[hasty, careful])
    assert [group.response for group in groups] == [hasty, careful]
    groups = make_groups([by_reward, by_minus_reward], label="return", response=hasty)
    assert [group.response for group in groups] == [hasty, hasty]


@pytest.mark.parametrize(
    ("references", "options", "error", "message"),
    [
        ([], {"label": "return"}, ValueError, "at least one rater group"),
        ("upper", {"label": "return"}, TypeError, r"list of references, got 'upper'"),
        ([3], {"label": "return"}, TypeError, "a reference or a function, got a int"),
        (["uper"], {"label": "return"}, ValueError, "Did you mean 'upper'"),
        ([by_reward], {}, ValueError, "exposes none.*use label='return'"),
        ([by_reward], {"label": "regrets"}, ValueError, "'regret' or 'return', got 'regrets'"),
        (
            ["upper", "popl_rl.envs.two_doors:upper"],
            {"label": "return"},
            ValueError,
            "two rater groups are called 'upper'",
        ),
        (
            [by_reward],
            {"label": "return", "response": [Response(), Response()]},
            ValueError,
            "1 groups, got 2 responses",
        ),
    ],
)
def test_bad_groups(references, options, error, message):
    with pytest.raises(error, match=message):
        make_groups(references, **options)


def test_a_label_and_advantages_go_together():
    with pytest.raises(ValueError, match=r"needs either advantages .* with no advantages"):
        RaterGroup("her", by_reward, Response(), "regret")
    with pytest.raises(ValueError, match="and label='return' none"):
        RaterGroup("her", by_reward, Response(), "return", torch.zeros(2, 2))


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (lambda s: s["speed"], ValueError, "batch size .* failed with KeyError"),
        (lambda s: s["reward"].numpy(), TypeError, "must return a float tensor.*got a ndarray"),
        (lambda s: s["reward"].sum(1), ValueError, r"\[3, 3\], got shape \[3\]; give each step"),
        (lambda s: s["observation"], ValueError, r"got shape \[3, 3, 1\]; reduce the last"),
        (lambda s: s["reward"].T[:2], ValueError, r"got shape \[2, 3\]\."),
        (lambda s: s["action"], TypeError, r"floats, got torch.int64; call \.float\(\)"),
        (lambda s: s["reward"] / 0 * 0, ValueError, "finite numbers, got 9 NaN or infinite of 9"),
    ],
)
def test_what_a_rater_returns_is_checked(segments, function, error, message):
    group = RaterGroup("broken", function, Response())
    with pytest.raises(error, match=message) as caught:
        group.perceived_utility(segments)
    assert "rater 'broken'" in str(caught.value)


def test_a_rater_may_return_float64(segments, table):
    """Everything comes out as if it had returned float32."""
    precise = lambda steps: by_reward(steps).double()  # noqa: E731
    for label in ("return", "regret"):
        one, other = (
            make_groups([utility], label=label, table=table)[0] for utility in (by_reward, precise)
        )
        for name in ("step_utility", "perceived_utility", "segment_utility"):
            found = [getattr(group, name)(segments) for group in (one, other)]
            assert torch.equal(*found)
            assert found[0].dtype == found[1].dtype


def test_numbers_too_large_for_float32_are_refused(segments):
    group = RaterGroup("large", lambda steps: by_reward(steps).double() + 1e300, Response())
    with pytest.raises(ValueError, match="9 NaN or infinite of 9, as float32"):
        group.step_utility(segments)


def test_regret_where_actions_do_not_begin_with_0(segments, table):
    steps = table.steps.clone()
    steps["action"] += 3
    shifted = Table(steps, table.next_state, table.terminal, table.start)
    later = segments.clone()
    later["action"] += 3
    one, other = (make_groups([by_reward], table=each)[0] for each in (table, shifted))
    assert torch.equal(one.perceived_utility(segments), other.perceived_utility(later))
    with pytest.raises(ValueError, match=r"knows 2 states and 2 actions, got .* number -3"):
        other.perceived_utility(segments)


def test_what_a_rater_raises_is_the_cause(segments):
    group = RaterGroup("broken", lambda s: s["speed"], Response())
    for shown, told in ((segments, "state"), (segments.exclude("info"), "nothing")):
        held = f"segments hold observation, action, reward, and in info {told}$"
        with pytest.raises(ValueError, match=f"broken.*{held}") as caught:
            group.step_utility(shown)
        assert isinstance(caught.value.__cause__, KeyError)


def test_regret_says_what_segments_lack(segments, table):
    (group,) = make_groups([by_reward], table=table)
    with pytest.raises(ValueError, match=r"needs \('info', 'state'\).*label='return'"):
        group.perceived_utility(segments.exclude("info"))
    with pytest.raises(ValueError, match="knows 2 states and 2 actions, got state 7"):
        group.perceived_utility(segments.clone().set(("info", "state"), torch.full((3, 3), 7)))
    with pytest.raises(ValueError, match="discrete actions"):
        group.perceived_utility(segments.clone().set("action", torch.zeros(3, 3, 2)))


@pytest.fixture
def groups():
    return make_groups([by_reward, by_minus_reward], label="return")


def test_shares_of_raters(groups, generator):
    raters = Raters.draw(groups, num_raters=10_000, shares=[0.9, 0.1], generator=generator)
    assert len(raters) == 10_000
    minority = raters.group_of.double().mean().item()
    assert minority == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / 10_000))


def test_equal_shares_are_the_default(groups, generator):
    raters = Raters.draw(groups, num_raters=10_000, generator=generator)
    assert raters.group_of.double().mean().item() == pytest.approx(0.5, abs=0.02)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_no_group_with_a_share_is_left_empty(seed, extra):
    generator = torch.Generator().manual_seed(seed)
    functions = [lambda s: s["reward"] for _ in range(4)]
    four = [RaterGroup(str(i), f, Response()) for i, f in enumerate(functions)]
    raters = Raters.draw(
        four, num_raters=3 + extra, shares=[0.98, 0.01, 0.01, 0.0], generator=generator
    )
    counts = raters.group_of.bincount(minlength=4)
    assert counts.sum() == 3 + extra
    if 3 + extra >= 4:
        assert (counts[:3] >= 1).all()
    assert counts[3] == 0


def test_one_rater_for_many_groups_is_allowed(groups, generator):
    assert len(Raters.draw(groups, num_raters=1, generator=generator)) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_raters": 0}, "num_raters must be at least 1, got 0"),
        ({"num_raters": 5, "shares": [1.0]}, r"2 groups \(by_reward, by_minus_reward\), got 1"),
        ({"num_raters": 5, "shares": [0.5, 0.6]}, "sum to 1, got .* with sum 1.1"),
        ({"num_raters": 5, "shares": [1.5, -0.5]}, "at least 0"),
        ({"num_raters": 5, "shares": [math.nan, 1.0]}, "at least 0"),
    ],
)
def test_bad_draws(groups, generator, options, message):
    with pytest.raises(ValueError, match=message):
        Raters.draw(groups, generator=generator, **options)


def test_drawing_and_making_need_groups(generator):
    with pytest.raises(ValueError, match="at least one rater group"):
        Raters.draw([], num_raters=3, generator=generator)
    with pytest.raises(ValueError, match="at least one rater group"):
        Raters((), torch.zeros(1, dtype=torch.int64))


def test_bad_raters(groups):
    with pytest.raises(ValueError, match=r"0\.\.1, got values from 0 to 2"):
        Raters(groups, torch.tensor([0, 2]))
    with pytest.raises(ValueError, match=r"with at least one, got \[0\]"):
        Raters(groups, torch.zeros(0, dtype=torch.int64))


def test_each_rater_answers_for_their_group(groups, segments, generator):
    raters = Raters(groups, torch.tensor([1, 0, 0]))
    segment_utility = raters.segment_utility(segments)
    assert segment_utility.tolist() == [[6.0, 6.0, 5.0], [-6.0, -6.0, -5.0]]
    pairs = torch.tensor([[0, 2], [0, 2], [2, 0], [0, 1], [0, 1]])
    answers = raters.answer(pairs, torch.tensor([0, 1, 2, 0, 1]), segment_utility, generator)
    assert answers.tolist() == [SECOND, FIRST, SECOND, TIE, TIE]
    assert answers.dtype == torch.int64


def test_each_group_answers_in_its_own_way(segments, generator):
    responses = [Response(), Response(mistake=1.0)]
    groups = make_groups([by_reward, by_minus_reward], label="return", response=responses)
    raters = Raters(groups, torch.tensor([0, 1]))
    pairs = torch.tensor([[0, 2], [0, 2]])
    answers = raters.answer(
        pairs, torch.tensor([0, 1]), raters.segment_utility(segments), generator
    )
    assert answers.tolist() == [FIRST, FIRST]


@pytest.mark.parametrize(
    ("pairs", "rater", "segment_utility", "message"),
    [
        (torch.zeros(4), torch.zeros(4), torch.zeros(2, 3), r"pairs must have shape \[pairs, 2\]"),
        (torch.zeros(4, 2), torch.zeros(3), torch.zeros(2, 3), r"rater must have shape \[4\]"),
        (torch.zeros(4, 2), torch.zeros(4), torch.zeros(3, 2), r"\[2 groups, .*got \[3, 2\]"),
    ],
)
def test_bad_questions(groups, generator, pairs, rater, segment_utility, message):
    with pytest.raises(ValueError, match=message):
        Raters(groups, torch.tensor([0, 1])).answer(
            pairs.long(), rater.long(), segment_utility, generator
        )
