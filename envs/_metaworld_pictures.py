"""Moving pictures of episodes, where there is a renderer."""

from pathlib import Path

import imageio.v3
import torch
from tensordict import TensorDict

from popl_rl.envs.metaworld_tasks import STEP_SECONDS, MetaworldTask
from popl_rl.keys import OBSERVATION
from popl_rl.segments import Behaviour

__all__ = ["record_gif"]


def record_gif(
    env: MetaworldTask,
    behaviour: Behaviour,
    path: Path,
    *,
    seed: int = 0,
    every: int = 4,
    generator: torch.Generator,
) -> bool:
    """Write an episode as an animated GIF in real time, and stay on its last frame for a second.

    Args:
        env: Environment to act in, made with ``render_mode="rgb_array"``.
        behaviour: Who acts; a policy's action for ``observation`` ``[1, 39]`` will do.
        path: File to write.
        seed: Seed of the episode's start.
        every: Steps of 12.5 ms from frame to frame.
        generator: Source of the behaviour's randomness.

    Returns:
        Whether the task was done.

    Raises:
        ValueError: If ``every`` is not positive.
        RuntimeError: If this machine has no renderer that works; says what to set.
    """
    if every < 1:
        raise ValueError(f"every must be at least 1, got {every}.")
    if hasattr(behaviour, "reset"):
        behaviour.reset()
    observation, info = env.reset(seed=seed)
    frames = [env.render()]
    over = False
    while not over:
        step = TensorDict({OBSERVATION: torch.from_numpy(observation).unsqueeze(0)}, [1])
        action = behaviour(step, generator)[0].detach()
        observation, _, terminated, truncated, info = env.step(action.numpy())
        over = terminated or truncated
        if over or int(info["time"]) % every == 0:
            frames.append(env.render())
    duration = [1000 * STEP_SECONDS * every] * (len(frames) - 1) + [1000.0]
    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.v3.imwrite(path, frames, extension=".gif", duration=duration, loop=0)
    return bool(info["success"])
