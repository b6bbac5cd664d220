"""MuJoCo simulators of Metaworld's tasks, which share one model for each task and process.

Building a model takes 0.3 s and 40 MB; what else an environment needs takes 0.3 ms and half a
megabyte. Evaluation asks for hundreds of environments at once, and steps them in turn.
"""

import difflib
import weakref
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from numpy.typing import NDArray

__all__ = [
    "OBSERVATION_SIZE",
    "Array",
    "Simulator",
    "SimulatorState",
    "simulated_task",
    "task_name",
]

Array = NDArray[np.float64]

#: Hand, gripper and objects now (18) and one step ago (18), and the goal (3).
OBSERVATION_SIZE = 39
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_NO_LIMIT = 2**31
_KEPT = (np.ndarray, np.generic, bool, int, float, type(None))


def task_name(task: str) -> str:
    """Metaworld's name of a task that may lack "-v3" or be written with underscores.

    Raises:
        ValueError: If there is no such task.
    """
    name = str(task).strip().lower().replace("_", "-").removesuffix("-v3")
    known = [entry.removesuffix("-v3") for entry in ALL_V3_ENVIRONMENTS]
    if name not in known:
        nearest = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
        hint = f"did you mean {' or '.join(map(repr, nearest))}?" if nearest else "it has no like."
        raise ValueError(
            f"task must be one of Metaworld's {len(known)} v3 tasks, got {task!r}; {hint} "
            f"All of them: {', '.join(known)}."
        )
    return f"{name}-v3"


@dataclass(frozen=True)
class SimulatorState:
    """All that a simulator goes on from.

    Attributes:
        physics: MuJoCo's integration state: positions, velocities, controls, mocap, warm start.
        body_pos: Where the model's bodies stand, which a task changes at each reset.
        site_pos: Where its marks are.
        attributes: What Metaworld's Python object keeps: target, last observation, counters.
    """

    physics: Array
    body_pos: Array
    site_pos: Array
    attributes: dict[str, Any] = field(repr=False)


class _Task:
    """What all simulators of a task share: Metaworld's environment as it was built, and its model.

    Args:
        name: Metaworld's name of the task.

    Attributes:
        env: Metaworld's environment, never reset nor stepped, with its goal visible.
        pristine: Its state.
        robot: Which of the model's shapes are the robot's.
    """

    def __init__(self, name: str) -> None:
        self.env = env = ALL_V3_ENVIRONMENTS[name]()
        # Metaworld hides the goal unless a benchmark's task, a pickle, says otherwise.
        env._partially_observable = False
        env._set_task_called = True
        env.__dict__.pop("sawyer_observation_space", None)  # cached with the goal hidden
        env.max_path_length = _NO_LIMIT  # it raises an error beyond; who uses it cuts episodes
        self.pristine = _state_of(env)
        self.robot = _below(env.model, "base")[env.model.geom_bodyid]
        self._kind = type(
            type(env).__name__, (type(env),), {"_get_curr_obs_combined_no_goal": _observation_now}
        )
        self._arrays = env.model.body_pos, env.model.site_pos
        self._holder: weakref.ref[Simulator] | None = None

    def make(self) -> Any:
        """Another environment of the task, on the same model."""
        made: Any = object.__new__(self._kind)
        shared = vars(self.env).items()
        vars(made).update({name: value for name, value in shared if not _is_of_mujoco(value)})
        made.data = mujoco.MjData(self.env.model)
        # What Metaworld calls their first places are views of where they are.
        made.init_left_pad = made.get_body_com("leftpad")
        made.init_right_pad = made.get_body_com("rightpad")
        return made

    def places(self) -> tuple[Array, Array]:
        """Where the model's bodies and marks are."""
        bodies, sites = self._arrays
        return bodies.copy(), sites.copy()

    def give_model_to(self, simulator: "Simulator") -> None:
        """Put the model's bodies and marks where they are in a simulator."""
        holder = None if self._holder is None else self._holder()
        if holder is simulator:
            return
        if holder is not None:
            holder.places = self.places()
        bodies, sites = self._arrays
        bodies[:], sites[:] = simulator.places
        self._holder = weakref.ref(simulator)


class Simulator:
    """Metaworld's environment of one task with its goal visible, and its state in hand.

    Args:
        name: Metaworld's name of the task.

    Attributes:
        env: Metaworld's environment, on the model that all simulators of the task share.
        places: Where the model's bodies and marks are in this one, while another has the model.
    """

    def __init__(self, name: str) -> None:
        self._task = simulated_task(name)
        pristine = self._task.pristine
        self.places = pristine.body_pos, pristine.site_pos
        self.env = self._task.make()
        self._was_reset = False

    def take_model(self) -> None:
        """Have the shared model as it is in this simulator."""
        self._task.give_model_to(self)

    def reset(self, np_random: np.random.Generator) -> Array:
        """Begin an episode, which depends on nothing but the generator; return the observation."""
        self._was_reset = True
        self.set_state(self._task.pristine)
        env = self.env
        env.np_random = np_random
        # The first pass draws where things are; the second starts with everything there. Metaworld
        # does the same, and with one pass its first observation shows where things were before.
        env._freeze_rand_vec, env.seeded_rand_vec = False, True
        env.reset_model()
        env._freeze_rand_vec = True
        mujoco.mj_resetData(env.model, env.data)
        env.reset_model()
        mujoco.mj_forward(env.model, env.data)
        env._prev_obs = env._get_curr_obs_combined_no_goal()
        observation: Array = env._get_obs()
        return self._clipped(observation)

    def step(self, action: NDArray[np.float32]) -> tuple[Array, float, bool]:
        """Return observation, reward and success of a step; actions are clipped to [-1, 1]."""
        self.take_model()
        observation, reward, _, _, info = self.env.step(np.clip(action, -1.0, 1.0))
        return observation, float(reward), bool(info["success"])

    def hand(self) -> Array:
        """Position of the hand in metres, ``[3]``."""
        position: Array = self.env.data.body("hand").xpos.copy()
        return position

    def tip(self) -> Array:
        """Position of the point between the fingertips in metres, ``[3]``."""
        position: Array = self.env.tcp_center
        return position

    def contact_force(self) -> float:
        """Sum of the normal forces between the robot and everything else, in newtons."""
        model, data = self.env.model, self.env.data
        if not data.ncon:
            return 0.0
        sides = self._task.robot[data.contact.geom]
        force, total = np.zeros(6), 0.0
        for index in np.flatnonzero(sides[:, 0] != sides[:, 1]).tolist():
            mujoco.mj_contactForce(model, data, index, force)
            total += abs(force[0])
        return float(total)

    def get_state(self) -> SimulatorState:
        """Copy the present state."""
        self.take_model()
        return _state_of(self.env)

    def set_state(self, state: SimulatorState) -> None:
        """Go on from a state, to the bit."""
        if not self._was_reset:
            self.reset(np.random.default_rng(0))  # what looks into MuJoCo's memory is made by it
        self.take_model()
        model, data = self.env.model, self.env.data
        model.body_pos[:], model.site_pos[:] = state.body_pos, state.site_pos
        vars(self.env).update({name: _kept(value) for name, value in state.attributes.items()})
        mujoco.mj_setState(model, data, state.physics, _STATE)
        mujoco.mj_forward(model, data)
        # That moved the solver's warm start, and with it the last bits of what comes next.
        mujoco.mj_setState(model, data, state.physics, _STATE)

    def _clipped(self, observation: Array) -> Array:
        space = self.env.sawyer_observation_space
        clipped: Array = np.clip(observation, space.low, space.high)
        return clipped


@cache
def simulated_task(name: str) -> _Task:
    """Return what all simulators of a task share in this process."""
    return _Task(name)


def _state_of(env: Any) -> SimulatorState:
    model, data = env.model, env.data
    physics = np.empty(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, physics, _STATE)
    # Listed anew each time: a task adds attributes at its first reset.
    attributes = {
        name: _kept(value)
        for name, value in vars(env).items()
        if isinstance(value, _KEPT) and not _is_of_mujoco(value)
    }
    return SimulatorState(physics, model.body_pos.copy(), model.site_pos.copy(), attributes)


def _observation_now(env: Any) -> Array:
    """Return hand, gripper and objects now, ``[18]``, as Metaworld puts them together.

    Bit by bit the same; Metaworld splits and stacks arrays, which takes a sixth of a step.
    """
    claws = [env.data.body(name).xpos for name in ("rightclaw", "leftclaw")]
    apart = np.linalg.norm(claws[0] - claws[1])
    place, turn = env._get_pos_objects(), env._get_quat_objects()
    seen = np.zeros(4 + env._obs_obj_max_len)
    seen[:3], seen[3] = env.get_endeff_pos(), min(max(apart / 0.1, 0.0), 1.0)
    for number in range(len(place) // 3):
        begin = 4 + 7 * number
        seen[begin : begin + 3] = place[3 * number : 3 * number + 3]
        seen[begin + 3 : begin + 7] = turn[4 * number : 4 * number + 4]
    return seen


def _kept(value: Any) -> Any:
    """Return a copy of an array; nobody is to write to what another holds."""
    return value.copy() if isinstance(value, np.ndarray) else value


def _is_of_mujoco(value: Any) -> bool:
    """Whether an array looks into memory of MuJoCo's, not into another array."""
    while isinstance(value, np.ndarray) and not value.flags.owndata:
        if not isinstance(value.base, np.ndarray):
            return True
        value = value.base
    return False


def _below(model: Any, name: str) -> NDArray[np.bool_]:
    """Return which bodies hang below a body, itself included, ``[bodies]``."""
    root = model.body(name).id
    inside = np.zeros(model.nbody, dtype=bool)
    for body in range(model.nbody):  # a parent's number is below its children's
        inside[body] = body == root or (body > 0 and inside[model.body_parentid[body]])
    return inside
