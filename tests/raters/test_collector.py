import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from popl_rl.data.pairs import draw_pairs
from popl_rl.data.saved import load_preferences, save_preferences
from popl_rl.data.segments import segment_buffer
from popl_rl.keys import ANSWER, CHANCE, GROUP, PAIR, RATER, UTILITY, Answer
from popl_rl.raters.collector import PreferenceCollector, collect_preferences
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.people import Raters
from popl_rl.raters.response import Response
from popl_rl.storage import save_tensordict


def by_action(segments):
    return segments["action"].float()


def against_action(segments):
    return -segments["action"].float()


@pytest.fixture
def three():
    """Segments of two steps with action 1 taken 0, 1 and 2 times."""
    action = torch.tensor([[0, 0], [1, 0], [1, 1]])
    return segment_buffer(
        TensorDict({"action": action, "observation": torch.zeros(3, 2, 1)}, [3, 2])
    )


@pytest.fixture
def raters():
    """Rater 0 and 2 like action 1, rater 1 does not; nobody makes mistakes."""
    groups = (
        RaterGroup("for", by_action, Response()),
        RaterGroup("against", against_action, Response()),
    )
    return Raters(groups, torch.tensor([0, 1, 0]))


def preference_buffer(segments, raters, generator):
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        transform=PreferenceCollector(segments, raters, generator=generator),
        batch_size=2,
    )


@given(st.integers(2, 6), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_every_pair_of_two_different_segments_is_drawn(num_segments, seed):
    pairs = draw_pairs(num_segments, 1000, generator=torch.Generator().manual_seed(seed))
    assert pairs.shape == (1000, 2)
    seen = {tuple(pair) for pair in pairs.tolist()}
    everything = {(i, j) for i in range(num_segments) for j in range(num_segments) if i != j}
    assert seen == everything


def test_chosen_queries_by_hand(three, raters, generator):
    """Worth of the segments to "for": 0, 1, 2; to "against": 0, -1, -2.

    Rater 0 ("for") prefers segment 2 to 0, so the second; rater 1 ("against") the first of (1, 2);
    rater 2 sees twice the same segment, a tie.
    """
    buffer = preference_buffer(three, raters, generator)
    pair, rater = torch.tensor([[0, 2], [1, 2], [1, 1]]), torch.tensor([0, 1, 2])
    buffer.extend(TensorDict({PAIR: pair, RATER: rater}, [3]))
    stored = buffer[:]
    assert stored[PAIR].tolist() == pair.tolist()
    assert stored[ANSWER].tolist() == [Answer.SECOND, Answer.FIRST, Answer.TIE]
    assert stored[RATER].tolist() == [0, 1, 2]
    assert stored[GROUP].tolist() == [0, 1, 0]
    assert stored[UTILITY].tolist() == [[0, 2], [-1, -2], [1, 1]]
    assert stored[ANSWER].dtype == stored[PAIR].dtype == torch.int64
    sample = buffer.sample()
    assert torch.equal(stored[sample["index"]][ANSWER], sample[ANSWER])


def test_queries_without_pairs_get_random_ones(three, raters, generator):
    buffer = preference_buffer(three, raters, generator)
    buffer.extend(TensorDict({RATER: torch.zeros(60, dtype=torch.long)}, [60]))
    stored = buffer[:]
    assert {tuple(pair) for pair in stored[PAIR].tolist()} == {
        (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1),
    }  # fmt: skip
    expected = (stored[PAIR][:, 1] > stored[PAIR][:, 0]).long()
    assert torch.equal(stored[ANSWER], expected)


def test_every_rater_answers_as_often(segments, groups):
    raters = Raters(groups, torch.tensor([0, 1, 1]))

    def collect(seed):
        generator = torch.Generator().manual_seed(seed)
        return collect_preferences(
            segment_buffer(segments), raters, answers_per_rater=7, generator=generator
        )[:]

    preferences = collect(0)
    assert preferences[RATER].bincount().tolist() == [7, 7, 7]
    segment_utility = raters.segment_utility(segments)
    expected = segment_utility[preferences[GROUP].unsqueeze(1), preferences[PAIR]]
    assert torch.equal(preferences[UTILITY], expected)
    strict = preferences[ANSWER] <= Answer.SECOND
    better = expected.argmax(1)
    assert torch.equal(preferences[ANSWER][strict], better[strict])
    assert bool((expected[~strict].diff(dim=1) == 0).all())
    for key in (PAIR, ANSWER):
        assert torch.equal(preferences[key], collect(0)[key])
        assert not torch.equal(preferences[key], collect(1)[key])


@pytest.mark.parametrize("rater", [-1, 3])
def test_unknown_raters_are_refused(three, raters, generator, rater):
    buffer = preference_buffer(three, raters, generator)
    with pytest.raises(ValueError, match=rf"rater must be ids in 0\.\.2, got .*{rater}"):
        buffer.extend(TensorDict({RATER: torch.tensor([0, rater])}, [2]))


@pytest.mark.parametrize("segment", [-1, 3])
def test_unknown_segments_are_refused(three, raters, generator, segment):
    buffer = preference_buffer(three, raters, generator)
    query = {RATER: torch.tensor([0]), PAIR: torch.tensor([[1, segment]])}
    with pytest.raises(ValueError, match=rf"pair must be segments in 0\.\.2, got .*{segment}"):
        buffer.extend(TensorDict(query, [1]))


def test_one_segment_is_not_enough(segments, raters, generator):
    message = "segments must hold at least two to compare, got 1"
    with pytest.raises(ValueError, match=message):
        PreferenceCollector(segment_buffer(segments[:1]), raters, generator=generator)


def test_no_answers_are_refused(three, raters, generator):
    with pytest.raises(ValueError, match="answers_per_rater must be at least 1, got 0"):
        collect_preferences(three, raters, answers_per_rater=0, generator=generator)


def test_saved_preferences_come_back_to_the_bit(preferences, tmp_path):
    save_tensordict(preferences, tmp_path / "preferences")
    loaded = load_preferences(tmp_path / "preferences", num_segments=40)
    for key in (PAIR, ANSWER, RATER, GROUP, UTILITY):
        assert torch.equal(loaded[key], preferences[key])


def foreign_pairs(data):
    data[PAIR][0, 1] = 40


def negative_pairs(data):
    data[PAIR][0, 0] = -1


def triples(data):
    data[PAIR] = torch.zeros(len(data), 3, dtype=torch.long)


def real_pairs(data):
    data[PAIR] = data[PAIR].float()


def unknown_answers(data):
    data[ANSWER][3] = 4


def negative_answers(data):
    data[ANSWER][3] = -1


def a_pair_of_one_segment(data):
    data[PAIR][5] = 3


def a_rater_below_unknown(data):
    data[RATER][2] = -5


def a_negative_group(data):
    data[GROUP][2] = -1


def a_certain_chance(data):
    data[CHANCE] = torch.full((len(data),), 1.5)


def no_raters(data):
    del data[RATER]


def flat_pairs(data):
    data[PAIR] = data[PAIR][:, 0]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (foreign_pairs, r"compares segments 0\.\.40, but there are 0\.\.39; these preferences"),
        (negative_pairs, r"compares segments -1\.\.39, but there are"),
        (triples, r"must hold pairs of segment numbers, int64 of shape \[M, 2\], got .*\[120, 3\]"),
        (real_pairs, "must hold pairs of segment numbers, .* got torch.float32"),
        (unknown_answers, r"holds answers outside 0\.\.3; it is damaged or foreign"),
        (negative_answers, r"holds answers outside 0\.\.3"),
        (a_pair_of_one_segment, "two different segments, but 1 compare a segment with itself"),
        (a_rater_below_unknown, r"must hold rater as whole numbers, unknown \(-1\) or .* got -5"),
        (a_negative_group, r"must hold hidden\.group as whole numbers, from 0, got -1"),
        (a_certain_chance, "must hold chances from 0 to 1"),
        (no_raters, "does not hold what was expected: 'rater'"),
        (flat_pairs, "'pair' with at least 2 dimensions is missing"),
    ],
)
def test_foreign_preferences_are_refused(preferences, tmp_path, damage, message):
    damage(preferences)
    save_tensordict(preferences, tmp_path / "data")
    with pytest.raises(ValueError, match=message):
        load_preferences(tmp_path / "data", num_segments=40)


def test_preferences_of_other_segments_are_refused(preferences, tmp_path):
    save_preferences(preferences, tmp_path / "data", segments="one")
    load_preferences(tmp_path / "data", num_segments=40, segments="one")
    with pytest.raises(ValueError, match="compares other segments than those beside it"):
        load_preferences(tmp_path / "data", num_segments=40, segments="other")


def test_no_preferences_at_all_are_refused(preferences, tmp_path):
    save_tensordict(preferences[:0], tmp_path / "data")
    with pytest.raises(ValueError, match="must hold pairs of segment numbers"):
        load_preferences(tmp_path / "data", num_segments=40)


def test_missing_preferences(tmp_path):
    with pytest.raises(FileNotFoundError, match="no saved data"):
        load_preferences(tmp_path / "data", num_segments=40)


def test_pairs_of_one_start_are_all_drawn_and_no_others():
    start = torch.tensor([5, 2, 5, 2, 2])
    pairs = draw_pairs(5, 2000, start=start, generator=torch.Generator().manual_seed(0))
    counts = {}
    for pair in pairs.tolist():
        counts[tuple(pair)] = counts.get(tuple(pair), 0) + 1
    allowed = {(0, 2), (2, 0)} | {(i, j) for i in (1, 3, 4) for j in (1, 3, 4) if i != j}
    assert set(counts) == allowed
    # A first segment is any of five, and its other any of those that share its start.
    assert counts[0, 2] / 2000 == pytest.approx(1 / 5, abs=0.04)
    assert counts[1, 3] / 2000 == pytest.approx(1 / 10, abs=0.03)


def test_a_start_of_a_single_segment_is_refused():
    with pytest.raises(ValueError, match="1 of 2 starts have a single one"):
        draw_pairs(3, 4, start=torch.tensor([0, 0, 1]), generator=torch.Generator())


def test_raters_compare_what_begins_in_the_same_state(raters):
    action = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    start = torch.tensor([[0, 0], [1, 1], [0, 0], [1, 1]])
    steps = {"action": action, "observation": torch.zeros(4, 2, 1), "info": {"start": start}}
    segments = segment_buffer(TensorDict(steps, [4, 2]))
    generator = torch.Generator().manual_seed(0)
    asked = collect_preferences(segments, raters, answers_per_rater=30, generator=generator)[:]
    assert torch.equal(start[asked[PAIR][:, 0], 0], start[asked[PAIR][:, 1], 0])
    assert set(asked[PAIR].flatten().tolist()) == {0, 1, 2, 3}
