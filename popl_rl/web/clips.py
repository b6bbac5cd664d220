"""What people see of a segment: a strip of pictures, or text.

A strip is one still picture, its frames side by side; the page shows one after the other. Two
strips are drawn at the same moment and so stay in step, which two animations do not, and they can
be stopped by people whom motion disturbs.

Environments say how: ``render_segment(segment) -> frames`` draws one ``[T]`` from what it holds;
``describe_segment(segment) -> str`` tells it in words; ``record_segments(...)`` draws while it
collects again, where nothing but the simulator's state would do. Texts beside
the segments, ``texts.json``, come first. Where there is none of these the numbers are shown.
"""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3
import numpy as np
from numpy.typing import NDArray

from popl_rl.manifest import read_json
from popl_rl.storage import write_atomic

__all__ = ["Clip", "Clips", "film_strip", "read_clip", "write_clip"]

_MOST_FRAMES = 48
_SIDE = 320  # pixels of a frame's longer side at most
_QUALITY = 85  # of WebP

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Clip:
    """A segment as people see it.

    Attributes:
        frames: Frames of the strip; 0 for text.
        rate: Frames per second.
        strip: The strip as WebP; empty for text.
        text: The words; empty for a strip.
    """

    frames: int = 0
    rate: float = 0.0
    strip: bytes = b""
    text: str = ""

    def about(self) -> dict[str, Any]:
        """What the page must know besides the strip."""
        return {"frames": self.frames, "rate": self.rate, "text": self.text}


Clips = Mapping[int, Clip]


def film_strip(frames: Sequence[Frame], *, rate: float) -> Clip:
    """Frames side by side, no more and no larger than a page can bear.

    Args:
        frames: Pictures ``[H, W, 3]`` of one size; the last always stays.
        rate: Frames per second in which they happened.

    Raises:
        ValueError: If there are no frames.
    """
    if not len(frames):
        raise ValueError("frames must hold at least one picture, got none")
    every = -(-len(frames) // _MOST_FRAMES)
    kept = list(frames[::-1][::every])[::-1]
    smaller = -(-max(kept[0].shape[:2]) // _SIDE)
    strip = np.concatenate([_shrunk(frame, smaller) for frame in kept], axis=1)
    file = io.BytesIO()
    imageio.v3.imwrite(file, strip, extension=".webp", quality=_QUALITY, method=2)
    return Clip(len(kept), rate / every, file.getvalue())


def _shrunk(frame: Frame, by: int) -> Frame:
    """Means over squares of ``by`` pixels."""
    if by == 1:
        return frame
    height, width = (size // by * by for size in frame.shape[:2])
    cut = frame[:height, :width].reshape(height // by, by, width // by, by, -1)
    mean: Frame = cut.mean((1, 3)).round().astype(np.uint8)
    return mean


def write_clip(clip: Clip, folder: Path, index: int) -> None:
    """Keep a clip as ``<index>.json`` and, if it is a strip, ``<index>.webp``, the former last."""
    if clip.strip:
        write_atomic(folder / f"{index}.webp", clip.strip)
    write_atomic(folder / f"{index}.json", json.dumps(clip.about()))


def read_clip(folder: Path, index: int) -> Clip | None:
    """What ``write_clip`` wrote; None if it did not, or was interrupted."""
    about = folder / f"{index}.json"
    if not about.is_file():
        return None
    known = read_json(about, cure="remove it to draw the clip again")
    strip = (folder / f"{index}.webp").read_bytes() if known["frames"] else b""
    return Clip(known["frames"], known["rate"], strip, known["text"])
