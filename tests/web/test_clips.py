import io
import json
from functools import partial

import imageio.v3
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from popl_rl.config import EnvConfig
from popl_rl.experiments.data import build_world
from popl_rl.storage import save_tensordict
from popl_rl.web.clips import Clip, film_strip, read_clip, write_clip
from popl_rl.web.rendering import Scenes, policy_clips, segment_clips


def world(**settings):
    return partial(build_world, EnvConfig(**settings))


def grey(value, height=20, width=30):
    return np.full((height, width, 3), value, np.uint8)


def picture(clip):
    return imageio.v3.imread(io.BytesIO(clip.strip), extension=".webp")


def test_frames_lie_side_by_side():
    clip = film_strip([grey(0), grey(100), grey(200)], rate=10.0)
    assert (clip.frames, clip.rate, clip.text) == (3, 10.0, "")
    shown = picture(clip)
    assert shown.shape == (20, 90, 3)
    middle = [shown[10, 15 + 30 * place, 0] for place in range(3)]
    assert np.allclose(middle, [0, 100, 200], atol=4)


def test_long_and_large_films_are_thinned_and_the_last_frame_stays():
    clip = film_strip([grey(value, 640, 640) for value in range(0, 200, 2)], rate=80.0)
    assert clip.frames == 34  # every third of a hundred, counted from the end
    assert clip.rate == pytest.approx(80 / 3)
    shown = picture(clip)
    assert shown.shape == (320, 34 * 320, 3)
    assert abs(int(shown[160, -160, 0]) - 198) <= 4
    with pytest.raises(ValueError, match="frames must hold at least one picture, got none"):
        film_strip([], rate=1.0)


def test_clips_are_kept(tmp_path):
    clip = film_strip([grey(0), grey(9)], rate=10.0)
    write_clip(clip, tmp_path, 3)
    write_clip(Clip(text="words"), tmp_path, 4)
    assert read_clip(tmp_path, 3) == clip
    assert read_clip(tmp_path, 4) == Clip(text="words")
    assert read_clip(tmp_path, 5) is None


def test_a_segment_of_two_doors_is_drawn_as_it_happened():
    env = world(options={"size": 7})().make_for_data().unwrapped
    generator = torch.Generator().manual_seed(0)
    env.reset(seed=1)
    infos, frames = [], [env.get_frame(highlight=False, tile_size=24)]
    for _ in range(5):
        action = int(torch.randint(3, (), generator=generator))
        infos.append(env.step(action)[-1])
        frames.append(env.get_frame(highlight=False, tile_size=24))
    info = {name: torch.tensor([int(i[name]) for i in infos]) for name in infos[0]}
    drawn = env.render_segment(TensorDict({"info": TensorDict(info, [5])}, [5]))
    assert np.array_equal(np.stack(drawn), np.stack(frames))


def test_texts_beside_the_segments_come_first(tmp_path):
    (tmp_path / "texts.json").write_text(json.dumps(["zero", "one", "two"]))
    scenes = Scenes(world(), tmp_path, tmp_path / "clips")
    assert segment_clips(scenes, [2, 0]) == {2: Clip(text="two"), 0: Clip(text="zero")}
    with pytest.raises(ValueError, match=r"one for each segment, got 3; segment 3 is asked for"):
        segment_clips(scenes, [3])
    (tmp_path / "texts.json").write_text("[1]")
    with pytest.raises(ValueError, match="must hold a list of strings"):
        segment_clips(scenes, [0])


def test_items_are_told_in_words_by_a_process_of_its_own_and_once(tmp_path):
    segments = TensorDict(
        {
            "observation": torch.tensor([[[0.25]], [[0.5]]]),
            "action": torch.zeros(2, 1, dtype=torch.long),
            "reward": torch.zeros(2, 1),
            "info": {"coin": torch.zeros(2, 1)},
        },
        [2, 1],
    )
    save_tensordict(segments, tmp_path / "segments")
    scenes = Scenes(world(factory="hidden_utility"), tmp_path, tmp_path / "clips")
    told = []
    assert segment_clips(scenes, [1], progress=told.append) == {1: Clip(text="0.50")}
    assert told == [1]
    # What is there is read, though another would be drawn now.
    write_clip(Clip(text="kept"), scenes.folder, 1)
    assert segment_clips(scenes, [1]) == {1: Clip(text="kept")}


@pytest.mark.slow
def test_policies_are_drawn_from_one_start_in_one_length(tmp_path, config_of, tiny):
    from popl_rl.trainers import train_popl

    train_popl.run(config_of(*tiny, f"run_dir={tmp_path / 'run'}"))
    small = world(options={"size": 7})
    scenes = Scenes(small, tmp_path / "run" / "policies", tmp_path / "clips", max_steps=20)
    clips = policy_clips(scenes, [0])
    assert clips[0].frames > 1
