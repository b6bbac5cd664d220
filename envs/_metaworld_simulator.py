"""One MuJoCo simulator per Metaworld task and process, which many environments share in turn.

Building a simulator takes 0.3 s and 40 MB; what sets two environments of a task apart is a few
kilobytes of state, exchanged in 0.2 ms. Evaluation asks for hundreds of environments at once.
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

__all__ = ["OBSERVATION_SIZE", "Array", "Simulator", "SimulatorState", "simulator", "task_name"]

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

    def __getstate__(self) -> dict[str, Any]:
        """What another process goes on from, once its own simulator of the task was reset.

        What looks into MuJoCo's memory here looks into that of the other simulator there already.
        """
        kept = {name: value for name, value in self.attributes.items() if not _is_of_mujoco(value)}
        return {**vars(self), "attributes": kept}


class Simulator:
    """Metaworld's environment of one task with its goal visible, and its state in hand.

    Args:
        name: Metaworld's name of the task.
    """

    def __init__(self, name: str) -> None:
        self.env = env = ALL_V3_ENVIRONMENTS[name]()
        # Metaworld hides the goal unless a benchmark's task, a pickle, says otherwise.
        env._partially_observable = False
        env._set_task_called = True
        env.__dict__.pop("sawyer_observation_space", None)  # cached with the goal hidden
        env.max_path_length = _NO_LIMIT  # it raises an error beyond; who uses it cuts episodes
        self._pristine = self.get_state()
        self._owner: weakref.ref[Any] | None = None
        self._robot = _below(env.model, "base")[env.model.geom_bodyid]

    def owned_by(self, owner: Any) -> bool:
        """Whether the simulator is in the state of ``owner``."""
        return self.owner() is owner

    def owner(self) -> Any:
        """Whose state the simulator is in; None if nobody's or if that is gone."""
        return None if self._owner is None else self._owner()

    def give_to(self, owner: Any) -> None:
        """Note whose state the simulator is in."""
        self._owner = weakref.ref(owner)

    def reset(self, np_random: np.random.Generator) -> Array:
        """Begin an episode, which depends on nothing but the generator; return the observation."""
        self.set_state(self._pristine)
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
        sides = self._robot[data.contact.geom]
        force, total = np.zeros(6), 0.0
        for index in np.flatnonzero(sides[:, 0] != sides[:, 1]).tolist():
            mujoco.mj_contactForce(model, data, index, force)
            total += abs(force[0])
        return float(total)

    def get_state(self) -> SimulatorState:
        """Copy the present state."""
        model, data = self.env.model, self.env.data
        physics = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, data, physics, _STATE)
        # Listed anew each time: a task adds attributes at its first reset.
        own = vars(self.env).items()
        attributes = {name: _kept(value) for name, value in own if isinstance(value, _KEPT)}
        return SimulatorState(physics, model.body_pos.copy(), model.site_pos.copy(), attributes)

    def set_state(self, state: SimulatorState) -> None:
        """Go on from a state, to the bit."""
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
def simulator(name: str) -> Simulator:
    """Return this process's simulator of a task."""
    return Simulator(name)


def _kept(value: Any) -> Any:
    """Return a copy of an array, unless it looks into another's memory.

    One that looks into MuJoCo's data must go on doing so, and none of these is written to.
    """
    return value.copy() if isinstance(value, np.ndarray) and value.flags.owndata else value


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
