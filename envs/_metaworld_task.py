"""Metaworld's tasks as Gymnasium environments: repaired, with a state that can be restored."""

import math
import os
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from popl_rl.envs._metaworld_data import check_scripted, collect_continuations
from popl_rl.envs._metaworld_scripts import Scripted
from popl_rl.envs._metaworld_simulator import (
    OBSERVATION_SIZE,
    Simulator,
    SimulatorState,
    simulated_task,
    task_name,
)
from popl_rl.keys import ACTION
from popl_rl.processes import Workers

__all__ = ["SPEEDS", "STEP_SECONDS", "MetaworldTask", "TaskState"]

#: Seconds that a step takes: 5 frames of 2.5 ms.
STEP_SECONDS = 0.0125
#: Speeds of the scripted behaviours that data show, in m/s along each axis.
SPEEDS = (0.25, 0.4, 0.6, 0.8)
_SHADOW = 1024  # pixels a side of the map of what is in shadow


@dataclass(frozen=True)
class TaskState:
    """What ``MetaworldTask.set_state`` goes on from, in another process after a reset there.

    Attributes:
        simulator: The simulator's own state.
        time: Steps taken in the episode.
        success: Whether the task has been done.
        hand: Position of the hand, m.
        velocity: Its velocity during the last step, m/s.
        thing: Position of the (first) object, m.
        remaining: See ``MetaworldTask``.
        observation: The last observation.
        info: The last info.
    """

    simulator: SimulatorState
    time: int
    success: bool
    hand: NDArray[np.float64]
    velocity: NDArray[np.float64]
    thing: NDArray[np.float64]
    remaining: float
    observation: NDArray[np.float32]
    info: dict[str, Any]


class MetaworldTask(
    gymnasium.Env[NDArray[np.float32], NDArray[np.float32]], gymnasium.utils.EzPickle
):
    """One of Metaworld's tasks, repaired: goal visible, seeded, float32, numbers in every info.

    Observations are Metaworld's 39 numbers: hand, gripper, objects (18), the same a step earlier
    (18), goal (3), in metres. Actions move the hand's anchor by at most 1 cm per axis and step of
    12.5 ms, and the fourth closes the gripper. The reward is Metaworld's own dense one, 0 to 10.
    An episode terminates when the task is done or is truncated after ``max_steps``; either way it
    may be carried on.

    All environments of a task in a process share one model, so they are cheap to make; they must be
    used from one thread.

    Each ``info``, at a reset too, holds

    =====================  ===================================================================
    ``success``            1 from the step on which the task is done first, 0 before
    ``time``               steps taken in this episode
    ``hand_speed``         m/s, the hand's displacement in this step over its 12.5 ms
    ``hand_acceleration``  m/s², change of the hand's velocity since the last step
    ``contact_force``      N, sum of normal forces between robot and surroundings at the end
    ``object_speed``       m/s, the same as for the hand
    ``obj_to_target``      m, distance of the (first) object from its goal
    ``remaining``          m, distance of hand from object plus ``obj_to_target``; 0 once done
    ``closed``             m, how much ``remaining`` fell in this step
    =====================  ===================================================================

    Args:
        task: Name of the task, with or without "-v3"; underscores will do.
        max_steps: Steps after which an episode is truncated.
        terminate: Whether an episode ends when the task is done.
        speeds: Speeds of the scripted behaviours that data show, in m/s along each axis.
        render_mode: None or "rgb_array".
        size: Height and width of a rendered frame, in pixels.
        camera: Which of Metaworld's cameras to render.

    Raises:
        ValueError: If there is no such task, or another argument is out of its range.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 80}

    def __init__(
        self,
        task: str = "drawer-open",
        *,
        max_steps: int = 300,
        terminate: bool = True,
        speeds: Sequence[float] = SPEEDS,
        render_mode: str | None = None,
        size: int = 240,
        camera: str = "corner2",
    ) -> None:
        gymnasium.utils.EzPickle.__init__(
            self,
            task,
            max_steps=max_steps,
            terminate=terminate,
            speeds=tuple(speeds),
            render_mode=render_mode,
            size=size,
            camera=camera,
        )
        self.task = task_name(task)
        self.speeds = tuple(speeds)
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        self.max_steps = max_steps
        self.terminate = terminate
        self.render_mode = render_mode
        self.size = size
        self.camera = camera
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (OBSERVATION_SIZE,), dtype=np.float32
        )
        simulated_task(self.task)  # which takes a while the first time
        self._own: Simulator | None = None
        self._time: int | None = None
        self._renderer: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes this and the following ones reproducible."""
        super().reset(seed=seed, options=options)
        observation = self.simulator.reset(self.np_random)
        self._time, self._success = 0, False
        self._hand, self._velocity = self.simulator.hand(), np.zeros(3)
        self._thing = observation[4:7].copy()
        return self._answer(observation, False)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take an action; see the class for what comes back.

        Raises:
            ValueError: If the action is not of shape [4] and finite.
            RuntimeError: If there was no reset.
        """
        time = self._steps_taken("step")
        action = np.asarray(action, dtype=np.float32)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"action must be 4 finite numbers in [-1, 1], got {action}.")
        observation, reward, success = self.simulator.step(action)
        self._time = time + 1
        seen, info = self._answer(observation, success)
        terminated = self.terminate and self._success
        return seen, reward, terminated, self._time >= self.max_steps, info

    def get_state(self) -> TaskState:
        """Return all that the episode goes on from.

        Raises:
            RuntimeError: If there was no reset.
        """
        time = self._steps_taken("get_state")
        return TaskState(
            self.simulator.get_state(),
            time,
            self._success,
            self._hand,
            self._velocity,
            self._thing,
            self._remaining,
            self._observation,
            self._info,
        )

    def set_state(self, state: TaskState) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Go on from a state of the same task, to the bit; return its observation and info."""
        self.simulator.set_state(state.simulator)
        self._time, self._success = state.time, state.success
        self._remaining = state.remaining
        self._hand, self._velocity, self._thing = state.hand, state.velocity, state.thing
        self._observation, self._info = state.observation, state.info
        return self._observation.copy(), dict(self._info)

    def behaviours(self) -> dict[str, Scripted]:
        """Return what data can show: Metaworld's scripted policy, slow to quick, clean to rough.

        Returns:
            By name ``scripted/<m/s>`` and ``rough/<m/s>``; see ``Scripted``.
        """
        clean = {f"scripted/{v}": Scripted(self.task, speed=v, noise=0.1) for v in self.speeds}
        rough = {
            f"rough/{v}": Scripted(self.task, speed=v, noise=0.4, push=0.02) for v in self.speeds
        }
        return clean | rough

    def collect_segments(
        self,
        num_segments: int,
        length: int,
        *,
        generator: torch.Generator,
        progress: Callable[[int], None] | None = None,
        workers: Workers | None = None,
    ) -> TensorDict:
        """Collect segments: from each of many states, one at each of the scripted speeds.

        What can be done from one state, slowly or fast, is what people can compare. See
        ``popl_rl.envs._metaworld_data.collect_continuations``.

        Args:
            num_segments: Segments to collect, a multiple of the number of speeds.
            length: Steps of each.
            generator: Source of all randomness.
            progress: Called with the number of segments collected so far.
            workers: Processes that collect side by side, with the same result; this one if None.

        Raises:
            ValueError: If the scripted policy rarely does the task, or a number does not fit.
        """
        speeds = len(self.speeds)
        if speeds < 2 or num_segments % speeds:
            raise ValueError(
                f"data.segments must be a multiple of the scripted speeds, of which two or more "
                f"are needed, got {num_segments} segments and {speeds} speeds."
            )
        if workers is not None:
            workers.start()  # which takes about as long as the check
        check_scripted(self, episodes=4)
        return collect_continuations(
            self,
            starts=num_segments // speeds,
            per_start=speeds,
            length=length,
            generator=generator,
            progress=progress,
            workers=workers,
        )

    def record_segments(
        self,
        segments: TensorDictBase,
        wanted: Collection[int],
        keep: Callable[[int, list[Any]], None],
        *,
        generator: torch.Generator,
    ) -> None:
        """Draw some of the segments that were collected here, by collecting them again.

        A segment holds no state of the simulator, and nothing less would do.

        Args:
            segments: What ``collect_segments`` returned, ``[N, T]``.
            wanted: Numbers of those to draw.
            keep: Called with number and pictures of each, 20 for a second.
            generator: In the state in which ``collect_segments`` was given it.

        Raises:
            ValueError: If these segments were not collected so.
        """

        def check(index: int, steps: TensorDict, film: list[Any]) -> None:
            if not torch.equal(steps[ACTION], segments[ACTION][index]):
                raise ValueError(
                    f"segment {index} cannot be drawn: collected again, it comes out otherwise; "
                    "segments must be of this environment, this seed and this machine"
                )
            keep(index, film)

        speeds = len(self.speeds)
        collect_continuations(
            self,
            starts=len(segments) // speeds,
            per_start=speeds,
            length=segments.shape[1],
            generator=generator,
            films=set(wanted).__contains__,
            keep=check,
        )

    def render(self) -> NDArray[np.uint8]:  # type: ignore[override]
        """Return the present picture, ``[size, size, 3]``.

        Raises:
            RuntimeError: If there was no reset, or this machine has no renderer that works.
        """
        self._steps_taken("render")
        self.simulator.take_model()
        sim = self.simulator.env
        if self._renderer is None:
            self._renderer = _make_renderer(sim.model, self.size)
        self._renderer.update_scene(sim.data, camera=self.camera)
        picture: NDArray[np.uint8] = self._renderer.render()
        # Metaworld hangs its cameras in the corners upside down.
        return picture[::-1, ::-1].copy() if self.camera.startswith("corner") else picture

    def close(self) -> None:
        """Free the renderer; the simulator is kept for others."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _steps_taken(self, asked: str) -> int:
        """Return the steps of this episode, or tell that there is none."""
        if self._time is None:
            raise RuntimeError(f"call reset() before {asked}().")
        return self._time

    @property
    def simulator(self) -> Simulator:
        """The simulator, which is made where it is needed first."""
        if self._own is None:
            self._own = Simulator(self.task)
        return self._own

    def _answer(
        self, observation: NDArray[np.float64], success: bool
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Return observation and info, comparing with the step before."""
        hand, thing, goal = self.simulator.hand(), observation[4:7].copy(), observation[36:]
        self._success = self._success or success
        to_target = _length(thing - goal)
        reach = _length(self.simulator.tip() - thing)
        remaining = 0.0 if self._success else float(reach + to_target)
        closed = self._remaining - remaining if self._time else 0.0
        velocity = (hand - self._hand) / STEP_SECONDS
        # NumPy numbers, because TorchRL's reader of infos asks each value for its dtype.
        self._info = {
            "success": np.int64(self._success),
            "time": np.int64(self._time or 0),
            "hand_speed": np.float32(_length(velocity)),
            "hand_acceleration": np.float32(_length(velocity - self._velocity) / STEP_SECONDS),
            "contact_force": np.float32(self.simulator.contact_force()),
            "object_speed": np.float32(_length(thing - self._thing) / STEP_SECONDS),
            "obj_to_target": np.float32(to_target),
            "remaining": np.float32(remaining),
            "closed": np.float32(closed),
        }
        self._hand, self._velocity, self._thing = hand, velocity, thing
        self._remaining = remaining
        self._observation = observation.astype(np.float32)
        return self._observation.copy(), dict(self._info)


def _length(vector: NDArray[np.float64]) -> float:
    """As ``numpy.linalg.norm`` has it to the bit, which asks longer than it reckons."""
    return math.sqrt(vector.dot(vector))


def _make_renderer(model: Any, size: int) -> Any:
    wants_screen = os.environ.get("MUJOCO_GL", "glfw").lower() in ("", "glfw")
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    try:
        # Asked without a screen, GLFW warns, fails, and leaves something that fails once more.
        if wants_screen and sys.platform == "linux" and not screen:
            raise OSError("there is no screen")
        # Of 4096 pixels a side, shadows take a third of the time that a picture of 240 does.
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, _SHADOW)
        return mujoco.Renderer(model, size, size)
    except Exception as error:
        raise RuntimeError(
            f"MuJoCo found no renderer ({type(error).__name__}: {error}); set MUJOCO_GL to egl (no "
            "screen needed) or osmesa before Python starts, with the library installed (libegl1 or "
            "libosmesa6 on Debian)."
        ) from error
