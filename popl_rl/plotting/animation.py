"""Moving pictures of episodes, where there is a renderer."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v3
import torch
from torch import Tensor

__all__ = ["record_gif"]

_SHOWN = 20  # frames per second, as most viewers can show them


def record_gif(
    env: gymnasium.Env[Any, Any],
    act: Callable[[Tensor], Tensor],
    path: Path,
    *,
    seed: int = 0,
    max_steps: int = 1000,
) -> int:
    """Write an episode as an animated GIF in real time, and stay on its last frame for a second.

    Args:
        env: Environment to act in, made with ``render_mode="rgb_array"`` and with ``render_fps``,
            its steps per second, in its metadata; 10 if it does not say.
        act: Maps an observation ``[1, O]`` to an action ``[1]`` or ``[1, A]``.
        path: File to write.
        seed: Seed of the episode's start.
        max_steps: Steps after which the episode is cut.

    Returns:
        Number of frames.

    Raises:
        RuntimeError: If this machine has no renderer that works; says what to set.
        ValueError: If the environment was made for something else, or draws nothing.
    """
    rate = float(env.metadata.get("render_fps", 10))
    every = max(1, round(rate / _SHOWN))
    if env.unwrapped.render_mode != "rgb_array":
        raise ValueError(
            f"env must be made with render_mode='rgb_array', got {env.unwrapped.render_mode!r}"
        )
    observation, _ = env.reset(seed=seed)
    frames, time, over = [env.render()], 0, False
    while not over:
        action = act(torch.as_tensor(observation).float().unsqueeze(0))[0].detach()
        observation, _, terminated, truncated, _ = env.step(action.numpy())
        time += 1
        over = terminated or truncated or time >= max_steps
        if over or time % every == 0:
            frames.append(env.render())
    if any(frame is None for frame in frames):
        raise ValueError("render() must return a picture with render_mode='rgb_array', got None")
    duration = [1000 * every / rate] * (len(frames) - 1) + [1000.0]
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures: Any = frames
    imageio.v3.imwrite(path, pictures, extension=".gif", duration=duration, loop=0)
    return len(frames)
