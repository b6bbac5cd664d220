"""Clips of segments and of policies, each rendered once, in a process of their own.

Several renderers in one process draw wrongly (MuJoCo's contexts disturb each other), and what a
server shows must not depend on what else it does; so an environment is rendered in one process
that does nothing else, and what it has drawn is kept on disk.
"""

import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from popl_rl.data.environments import World, offered
from popl_rl.data.saved import load_segments
from popl_rl.keys import ACTION, OBSERVATION
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.sets import load_set
from popl_rl.randomness import stream
from popl_rl.web.clips import Clip, Clips, film_strip, read_clip, write_clip

__all__ = ["Scenes", "policy_clips", "segment_clips"]

_FILM_RATE = 20.0  # pictures per second of what an environment records itself
_RATE = 10.0  # steps per second, where the environment does not say
_BLOCK = 20  # clips between two reports of progress


@dataclass(frozen=True)
class Scenes:
    """What is to be rendered, as a process can be told it.

    Attributes:
        make_world: Makes the world; something that pickles.
        source: Folder of the segments, or of the policies.
        folder: Where clips are kept.
        seed: Of the starts of episodes; of the run whose segments these are.
        max_steps: Steps after which an episode of a policy is cut.
    """

    make_world: Callable[[], World]
    source: Path
    folder: Path
    seed: int = 0
    max_steps: int = 1000


def segment_clips(
    scenes: Scenes, wanted: Sequence[int], *, progress: Callable[[int], None] | None = None
) -> Clips:
    """Clips of some segments; those that were rendered before are read.

    Args:
        scenes: World, ``source/segments`` and, for texts, ``source/texts.json``.
        wanted: Rows of the segments.
        progress: Called with the number of clips that there are.

    Raises:
        ValueError: If ``texts.json`` does not fit the segments.
        RuntimeError: If this machine has no renderer that works; says what to set.
    """
    texts = scenes.source / "texts.json"
    if texts.is_file():
        return _texts(texts, wanted)
    return _rendered(scenes, wanted, _render_segments, progress)


def policy_clips(
    scenes: Scenes, members: Sequence[int], *, progress: Callable[[int], None] | None = None
) -> Clips:
    """Clips of an episode of each policy, all from one start, padded to one length.

    Args:
        scenes: World, and the folder of a policy set as ``source``.
        members: Whose episodes.
        progress: Called with the number of clips that there are.

    Raises:
        RuntimeError: If this machine has no renderer that works; says what to set.
    """
    return _rendered(scenes, members, _render_policies, progress)


def _texts(path: Path, wanted: Sequence[int]) -> Clips:
    texts = json.loads(path.read_text(encoding="utf-8"))
    proper = isinstance(texts, list) and all(isinstance(text, str) for text in texts)
    if not proper or len(texts) <= max(wanted):
        raise ValueError(
            f"{path} must hold a list of strings, one for each segment, got "
            f"{len(texts) if proper else 'something else'}; segment {max(wanted)} is asked for"
        )
    return {index: Clip(text=texts[index]) for index in wanted}


def _rendered(
    scenes: Scenes,
    wanted: Sequence[int],
    render: Callable[[Scenes, list[int]], None],
    progress: Callable[[int], None] | None,
) -> Clips:
    scenes.folder.mkdir(parents=True, exist_ok=True)
    clips = {index: read_clip(scenes.folder, index) for index in wanted}
    missing = [index for index, clip in clips.items() if clip is None]
    if missing and render is _render_policies:
        missing = list(wanted)  # they are padded to one length
    if missing:
        blocks = [missing]
        if render is _render_segments and not _records(scenes):
            blocks = [missing[at : at + _BLOCK] for at in range(0, len(missing), _BLOCK)]
        done = len(clips) - len(missing)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            for block in blocks:
                pool.submit(render, scenes, block).result()
                done += len(block)
                if progress is not None:
                    progress(done)
        clips |= {index: read_clip(scenes.folder, index) for index in missing}
    found = {index: clip for index, clip in clips.items() if clip is not None}
    assert len(found) == len(clips)
    return found


def _records(scenes: Scenes) -> bool:
    """Whether segments are shown by collecting them again, all at once."""
    world = scenes.make_world()
    records = offered(world.env, "record_segments") is not None
    world.env.close()
    return records


def _render_segments(scenes: Scenes, wanted: list[int]) -> None:
    """Draw, or tell in words, some segments; runs in a process of its own."""
    torch.set_num_threads(1)
    segments = load_segments(scenes.source / "segments")
    env = scenes.make_world().make_for_data()
    rate = float(env.metadata.get("render_fps", _RATE))
    record, render = offered(env, "record_segments"), offered(env, "render_segment")
    describe = offered(env, "describe_segment")
    if record is not None:

        def keep(index: int, frames: list[Any]) -> None:
            write_clip(film_strip(frames, rate=_FILM_RATE), scenes.folder, index)

        record(segments, set(wanted), keep, generator=stream(scenes.seed, "segments"))
        return
    for index in wanted:
        segment = segments[index]
        if render is not None:
            clip = film_strip(render(segment), rate=min(rate, _RATE))
        elif describe is not None:
            clip = Clip(text=describe(segment))
        else:
            clip = Clip(text=_numbers(segment))
        write_clip(clip, scenes.folder, index)


def _numbers(segment: TensorDictBase) -> str:
    """Observation and action of each step, for want of anything better."""
    lines = []
    for seen, done in zip(segment[OBSERVATION].tolist(), segment[ACTION].tolist(), strict=True):
        action = done if isinstance(done, list) else [done]
        row = " ".join(f"{number:.2f}" for number in seen)
        lines.append(f"{row} → {' '.join(f'{number:g}' for number in action)}")
    return "\n".join(lines)


def _render_policies(scenes: Scenes, members: list[int]) -> None:
    """Roll policies from one start and draw them; runs in a process of its own."""
    torch.set_num_threads(1)
    policies = load_set(scenes.source)
    assert isinstance(policies, PolicySet)
    env: Any = scenes.make_world().make()
    env.unwrapped.render_mode = "rgb_array"
    rate = float(env.metadata.get("render_fps", _RATE))
    films = {}
    for member in members:
        generator = torch.Generator().manual_seed(scenes.seed)
        seen, _ = env.reset(seed=scenes.seed)
        frames, over = [env.render()], False
        while not over and len(frames) <= scenes.max_steps:
            batch = torch.as_tensor(seen).float().unsqueeze(0)
            action = policies.act(batch, member=member, generator=generator)[0].numpy().copy()
            seen, _, ended, cut, _ = env.step(action)
            over = ended or cut
            frames.append(env.render())
        films[member] = frames
    longest = max(map(len, films.values()))
    for member, frames in films.items():
        padded = frames + frames[-1:] * (longest - len(frames))
        write_clip(film_strip(padded, rate=min(rate, 80.0)), scenes.folder, member)
    env.close()
