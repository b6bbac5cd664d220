import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import NonTensorData, TensorDict

from popl_rl.data.bank import SegmentBank
from popl_rl.data.behaviours import random_behaviour, table_behaviour
from popl_rl.data.rollouts import MASK
from popl_rl.data.segments import collect_segments, cut_segments, segment_buffer, stored_segments
from popl_rl.storage import load_tensordict, save_tensordict
from popl_rl.testing import tiny_env


def episodes_of(lengths, horizon):
    """Episodes whose action is the time of the step, counted from 100 for each episode."""
    time = torch.arange(horizon).expand(len(lengths), -1)
    mask = time < torch.tensor(lengths).unsqueeze(1)
    number = 100 * torch.arange(len(lengths)).unsqueeze(1) + time
    data = {"action": number * mask, "info": {"time": time * mask}, MASK: mask}
    return TensorDict(data, mask.shape)


def everything_equal(one, other):
    keys = set(one.keys(True, True))
    same_keys = keys == set(other.keys(True, True))
    return same_keys and all(
        one[key].dtype == other[key].dtype and torch.equal(one[key], other[key]) for key in keys
    )


def always_right(step, generator):
    return torch.ones(step.batch_size, dtype=torch.long)


def test_segments_are_counted_from_the_end_of_each_episode():
    """Segments of 3 from episodes of 5, 2 and 7 steps.

    The first keeps its steps 2-4 (0 and 1 are left over), the second is too short, and the third
    keeps 4-6 and 1-3 (0 is left over).
    """
    segments = cut_segments(episodes_of([5, 2, 7], 7), 3)
    assert segments.batch_size == (3, 3)
    assert segments["action"].tolist() == [[2, 3, 4], [204, 205, 206], [201, 202, 203]]
    assert segments["info", "time"].tolist() == [[2, 3, 4], [4, 5, 6], [1, 2, 3]]
    assert set(segments.keys()) == {"action", "info"}


@given(st.lists(st.integers(0, 9), min_size=1, max_size=5), st.integers(1, 10))
@settings(max_examples=40, deadline=None)
def test_every_step_is_cut_at_most_once_and_only_the_start_is_left_over(lengths, length):
    segments = cut_segments(episodes_of(lengths, 9), length)["action"]
    assert segments.shape == (sum(n // length for n in lengths), length)
    expected = [
        100 * episode + time
        for episode, n in enumerate(lengths)
        for time in range(n % length, n)
        if n >= length
    ]
    assert segments.flatten().sort().values.tolist() == expected
    assert bool((segments.diff(dim=1) == 1).all())


def test_no_segment_when_all_episodes_are_too_short():
    segments = cut_segments(episodes_of([2, 1], 4), 5)
    assert segments.batch_size == (0, 5)
    assert segments["info", "time"].shape == (0, 5)


def test_a_table_behaviour_acts_on_the_state_that_the_last_step_led_to(generator):
    act = table_behaviour(torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    info = {"state": torch.tensor([0, 0, 0]), "next_state": torch.tensor([1, 0, 1])}
    assert act(TensorDict({"info": info}, [3]), generator).tolist() == [2, 1, 2]


def test_random_behaviour_of_a_discrete_space(generator):
    act = random_behaviour(gymnasium.spaces.Discrete(3))
    actions = act(TensorDict({}, [200]), generator)
    assert actions.dtype == torch.int64
    assert actions.unique().tolist() == [0, 1, 2]


def test_random_behaviour_of_a_box_fills_it_with_float32(generator):
    space = gymnasium.spaces.Box(np.array([-1.0, 2.0]), np.array([1.0, 6.0]), dtype=np.float64)
    actions = random_behaviour(space)(TensorDict({}, [500]), generator)
    assert actions.shape == (500, 2)
    assert actions.dtype == torch.float32
    torch.testing.assert_close(actions.amin(0), torch.tensor([-1.0, 2.0]), atol=0.1, rtol=0)
    torch.testing.assert_close(actions.amax(0), torch.tensor([1.0, 6.0]), atol=0.1, rtol=0)
    assert all(space.contains(action.double().numpy()) for action in actions)


@pytest.mark.parametrize(
    "space", [gymnasium.spaces.Box(-np.inf, np.inf, (2,)), gymnasium.spaces.MultiBinary(2)]
)
def test_random_behaviour_refuses_other_spaces(space):
    with pytest.raises(TypeError, match="action_space must be Discrete or a bounded Box, got"):
        random_behaviour(space)


def test_segments_show_what_the_environment_does(segments):
    state, after = segments["info", "state"], segments["info", "next_state"]
    assert segments.batch_size == (40, 4)
    assert torch.equal(segments["observation"].argmax(-1), state)
    assert torch.equal((state + 2 * segments["action"] - 1).clamp(0, 4), after)
    assert torch.equal(after[:, :-1], state[:, 1:])


def test_collecting_is_reproducible():
    def collect(seed):
        behaviours = {"random": random_behaviour(tiny_env().action_space)}
        generator = torch.Generator().manual_seed(seed)
        return collect_segments(
            tiny_env, behaviours, num_segments=30, length=5, generator=generator, num_envs=4
        )

    assert everything_equal(collect(3), collect(3))
    assert not everything_equal(collect(3), collect(4))


@pytest.mark.parametrize(
    ("shares", "expected"), [(None, 5), ({"left": 0.3, "right": 0.7}, 7), ({"right": 1.0}, 10)]
)
def test_behaviours_give_their_shares_and_progress_is_told(generator, shares, expected):
    behaviours = {"left": lambda *args: 1 - always_right(*args), "right": always_right}
    told = []
    segments = collect_segments(
        lambda: tiny_env(max_steps=4),
        behaviours,
        num_segments=10,
        length=2,
        generator=generator,
        shares=shares,
        num_envs=3,
        progress=told.append,
    )
    assert len(segments) == 10
    assert int(segments["action"].all(1).sum()) == expected
    assert told == sorted(told)
    assert told[-1] == 10


def test_the_order_of_segments_does_not_tell_the_behaviour(generator):
    behaviours = {"left": lambda *args: 1 - always_right(*args), "right": always_right}
    segments = collect_segments(
        tiny_env, behaviours, num_segments=40, length=2, generator=generator, num_envs=4
    )
    first_half = int(segments["action"][:20, 0].sum())
    assert 0 < first_half < 20


class Forgetful:
    """Turns around after each batch of episodes; counts how often it was reset."""

    resets = 0

    def reset(self):
        self.resets += 1

    def __call__(self, step, _generator):
        return torch.full(step.batch_size, self.resets % 2)


def test_a_behaviour_with_memory_is_reset_for_each_batch(generator):
    behaviour = Forgetful()
    segments = collect_segments(
        lambda: tiny_env(max_steps=4),
        {"forgetful": behaviour},
        num_segments=8,
        length=4,
        generator=generator,
        num_envs=2,
    )
    assert behaviour.resets == 4
    assert int(segments["action"].all(1).sum()) == 4


class Closable(gymnasium.Wrapper):
    closed = 0

    def close(self):
        type(self).closed += 1


def test_too_long_segments_are_refused_and_environments_closed(generator):
    Closable.closed = 0
    message = (
        r"length must not exceed the episodes' length: 10 episodes of behaviour 'right' gave no "
        r"segment of 9 steps \(the longest of the last 2 had 3\); choose shorter segments"
    )
    with pytest.raises(ValueError, match=message):
        collect_segments(
            lambda: Closable(tiny_env(max_steps=3)),
            {"right": always_right},
            num_segments=10,
            length=9,
            generator=generator,
            num_envs=2,
        )
    assert Closable.closed == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_segments": 0}, "num_segments must be at least 1, got 0"),
        ({"length": 0}, "length must be at least 1, got 0"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"num_envs": -1}, "num_envs must be at least 1, got -1"),
        ({"behaviours": {}}, "behaviours must hold at least one behaviour, got none"),
        ({"shares": {"right": 0.5}}, "shares must be non-negative, sum to 1 and name behaviours"),
        ({"shares": {"right": 0.5, "typo": 0.5}}, r"out of \['right'\], got .*typo"),
        ({"shares": {"right": float("nan")}}, "shares must be non-negative"),
    ],
)
def test_collecting_refuses(generator, change, message):
    arguments = {"behaviours": {"right": always_right}, "num_segments": 4, "length": 2, **change}
    with pytest.raises(ValueError, match=message):
        collect_segments(tiny_env, arguments.pop("behaviours"), generator=generator, **arguments)


@pytest.mark.parametrize("kind", ["memory", "memmap"])
def test_a_buffer_holds_one_item_per_segment(segments, tmp_path, kind):
    folder = tmp_path / "buffer" if kind == "memmap" else None
    buffer = segment_buffer(segments, memmap=folder, batch_size=7)
    assert len(buffer) == 40
    assert everything_equal(stored_segments(buffer), segments)
    assert stored_segments(buffer).batch_size == (40, 4)
    sample = buffer.sample()
    assert sample.batch_size == (7,)
    assert torch.equal(segments["action"][sample["index"]], sample["action"])
    assert (folder is not None) == any(tmp_path.rglob("*.memmap"))


def test_a_batch_is_no_larger_than_the_buffer(segments):
    assert segment_buffer(segments[:3]).sample().batch_size == (3,)


def test_infos_may_be_empty(generator, tmp_path):
    make = lambda: gymnasium.make("CartPole-v1")  # noqa: E731
    behaviours = {"random": random_behaviour(make().action_space)}
    segments = collect_segments(
        make, behaviours, num_segments=6, length=3, generator=generator, num_envs=2
    )
    stored = stored_segments(segment_buffer(segments))
    save_tensordict(stored, tmp_path / "segments")
    loaded = load_tensordict(tmp_path / "segments", required={"info": 0})
    assert everything_equal(loaded, segments)


def test_a_bank_of_repeated_observations_keeps_each_once(segments):
    bank = SegmentBank.from_segments(segments)
    assert bank.is_shared
    assert bank.observation.shape == (5, 5)
    assert len(bank) == 40
    assert torch.equal(bank.observation[bank.row], segments["observation"])
    assert torch.equal(bank.action, segments["action"])


@pytest.mark.parametrize(("distinct", "is_shared"), [(2, True), (3, False)])
def test_observations_are_shared_if_a_quarter_or_less_are_distinct(distinct, is_shared):
    """Eight steps: two distinct observations are a quarter of them, three are more."""
    observation = (torch.arange(8) % distinct).float().view(4, 2, 1)
    segments = TensorDict({"observation": observation, "action": torch.zeros(4, 2)}, [4])
    bank = SegmentBank.from_segments(segments)
    assert bank.is_shared == is_shared
    assert len(bank.observation) == (distinct if is_shared else 8)
    assert torch.equal(bank.observation[bank.row], observation)


def test_a_bank_can_be_moved(bank):
    moved = bank.to("cpu")
    assert moved.is_shared == bank.is_shared
    for name in ("observation", "row", "action"):
        assert torch.equal(getattr(moved, name), getattr(bank, name))


def test_saved_data_come_back_to_the_bit(tmp_path, generator):
    data = TensorDict(
        {
            "a b": torch.randn(3, 2, generator=generator),
            "bool": torch.tensor([True, False, True]),
            "hidden": {"int": torch.arange(3), "deep": {"double": torch.rand(3).double()}},
        },
        [3],
    )
    save_tensordict(data, tmp_path / "new" / "data")
    loaded = load_tensordict(tmp_path / "new" / "data")
    assert everything_equal(loaded, data)
    assert loaded.batch_size == (3,)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["data"]


def test_loaded_data_do_not_hang_on_the_file(tmp_path):
    save_tensordict(TensorDict({"a": torch.zeros(2)}, [2]), tmp_path / "data")
    load_tensordict(tmp_path / "data")["a"].fill_(1)
    assert load_tensordict(tmp_path / "data")["a"].tolist() == [0, 0]


def test_an_existing_path_is_left_as_it_is(tmp_path):
    (tmp_path / "data").mkdir()
    with pytest.raises(FileExistsError, match=r"data exists; remove it or choose another path"):
        save_tensordict(TensorDict({"a": torch.zeros(2)}, [2]), tmp_path / "data")
    assert list(tmp_path.rglob("*")) == [tmp_path / "data"]


@pytest.mark.parametrize("failing", ["memmap", "rename"])
def test_a_failed_save_leaves_nothing_behind(tmp_path, monkeypatch, failing):
    def fail(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr(TensorDict if failing == "memmap" else type(tmp_path), failing, fail)
    with pytest.raises(OSError, match="No space left"):
        save_tensordict(TensorDict({"a": torch.zeros(2)}, [2]), tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_loading_what_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no saved data at .*nothing: expected the folder"):
        load_tensordict(tmp_path / "nothing")


def cut(folder):
    file = folder / "info" / "time.memmap"
    file.write_bytes(file.read_bytes()[:-1])


def empty(folder):
    (folder / "action.memmap").write_bytes(b"")


def lengthen(folder):
    file = folder / "action.memmap"
    file.write_bytes(file.read_bytes() + b"x")


def remove_tensor(folder):
    (folder / "action.memmap").unlink()


def remove_meta(folder):
    (folder / "meta.json").unlink()


def cut_meta(folder):
    file = folder / "meta.json"
    file.write_text(file.read_text()[:-5])


def list_meta(folder):
    (folder / "meta.json").write_text("[1, 2]")


@pytest.mark.parametrize(
    "damage", [cut, empty, lengthen, remove_tensor, remove_meta, cut_meta, list_meta]
)
def test_damaged_data_are_refused(tmp_path, damage):
    save_tensordict(episodes_of([3, 4], 4), tmp_path / "data")
    damage(tmp_path / "data")
    sizes = {path: path.stat().st_size for path in tmp_path.rglob("*")}
    with pytest.raises(ValueError, match=r"data is not readable as saved data \(.*truncated or"):
        load_tensordict(tmp_path / "data")
    assert sizes == {path: path.stat().st_size for path in tmp_path.rglob("*")}


def test_pickles_are_refused(tmp_path):
    data = TensorDict({"a": torch.zeros(2), "b": NonTensorData(Forgetful(), batch_size=[2])}, [2])
    data.memmap(tmp_path / "data")
    assert list(tmp_path.rglob("*.pickle"))
    with pytest.raises(ValueError, match=r"not readable as saved data .*pickle"):
        load_tensordict(tmp_path / "data")


@pytest.mark.parametrize("required", [{"other": 0}, {("info", "other"): 1}, {"action": 3}])
def test_data_of_another_kind_are_refused(tmp_path, required):
    save_tensordict(episodes_of([3, 4], 4), tmp_path / "data")
    with pytest.raises(ValueError, match=r"data does not hold .* is missing; it has \["):
        load_tensordict(tmp_path / "data", required=required)
    assert load_tensordict(tmp_path / "data", required={"action": 2, "info": 0}) is not None


def test_memory_mapped_segments_are_found_again_and_mended(segments, tmp_path):
    segment_buffer(segments, memmap=tmp_path)
    (file,) = tmp_path.glob("segments-*/action.memmap")
    before = file.stat().st_ino
    segment_buffer(segments, memmap=tmp_path)
    assert file.stat().st_ino == before
    damaged = bytearray(file.read_bytes())
    damaged[3] ^= 1
    file.write_bytes(damaged)
    mended = stored_segments(segment_buffer(segments, memmap=tmp_path))
    assert torch.equal(mended["action"], segments["action"])
    segment_buffer(segments[:5], memmap=tmp_path)
    assert len(list(tmp_path.glob("segments-*"))) == 2
