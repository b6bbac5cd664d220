"""The single checks behind ``popl_rl.testing.check_env``.

Each raises, with a cure, for what training trips over, and warns of what it does not.

``name`` is what messages call the environment.
"""

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from torchrl import logger
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from popl_rl.data.adapters import native_spaces
from popl_rl.data.behaviours import first_action
from popl_rl.data.environments import counting_from_zero, offered
from popl_rl.data.plugged import CheckedBehaviour
from popl_rl.data.rollouts import numeric_info
from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD
from popl_rl.plug_ins import call
from popl_rl.testing.plug_ins import Env

__all__ = [
    "Step",
    "check_acting",
    "check_repeats",
    "check_spaces",
    "check_table",
    "check_torchrl",
    "random_steps",
]


class Step(NamedTuple):
    """What an environment said; ``action`` is None for a reset."""

    action: Any
    observation: NDArray[np.float32]
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, float]


def check_spaces(name: str, env: Env) -> None:
    """Check that there is something to act with: random actions, or behaviours."""
    acts = env.action_space
    bounded = not isinstance(acts, gymnasium.spaces.Box) or acts.is_bounded()
    if not bounded and offered(env, "behaviours") is None:
        raise ValueError(
            f"env {name!r}: a Box of actions must be bounded where there are no behaviours(), got "
            f"{acts}; give it low and high, or behaviours that show what to do."
        )


def random_steps(name: str, env: Env, num_steps: int, seed: int) -> list[Step]:
    """Take random steps, checking each answer; an episode's first entry is its reset."""
    env.action_space.seed(seed)
    steps: list[Step] = []
    over = True
    first_reset = True
    outside = ""
    for _ in range(num_steps):
        if over:
            # Later episodes go on from the first seed, which a careless reset would also get wrong.
            answer = call("env", name, "reset", env.reset, seed=seed if first_reset else None)
            first_reset = False
            if not isinstance(answer, tuple) or len(answer) != 2:
                raise TypeError(
                    f"env {name!r}: reset must return (observation, info), got "
                    f"{_described(answer)}."
                )
            action, (observation, info), reward = None, answer, 0.0
            terminated = truncated = over = False
        else:
            action = env.action_space.sample()
            answer = call("env", name, "step", env.step, action)
            if not isinstance(answer, tuple) or len(answer) != 5:
                raise TypeError(
                    f"env {name!r}: step must return (observation, reward, terminated, truncated, "
                    f"info), got {_described(answer)}."
                )
            observation, reward, terminated, truncated, info = answer
            _check_outcome(name, reward, terminated, truncated)
            over = bool(terminated or truncated)
        seen = _checked_observation(name, env, observation)
        if not outside and not env.observation_space.contains(seen):
            outside = f"values from {seen.min():g} to {seen.max():g}"
        numbers = _checked_info(name, info)
        ends = bool(terminated), bool(truncated)
        steps.append(Step(action, seen, float(reward), *ends, numbers))
    if outside:
        warnings.warn(
            f"env {name!r}: observations should lie in {env.observation_space}, got {outside}; "
            "training does not mind, others may: correct the space.",
            stacklevel=3,
        )
    return steps


def _described(answer: Any) -> str:
    return f"{len(answer)} values" if isinstance(answer, tuple) else f"a {type(answer).__name__}"


def _checked_observation(name: str, env: Env, observation: Any) -> NDArray[np.float32]:
    """A copy, since an environment may give the same array again and again."""
    try:
        seen = np.array(observation, np.float32)
    except (TypeError, ValueError):
        raise TypeError(
            f"env {name!r}: observations must be arrays of numbers, got a "
            f"{type(observation).__name__}."
        ) from None
    if seen.shape != env.observation_space.shape:
        raise ValueError(
            f"env {name!r}: observations must have the shape {env.observation_space.shape} of the "
            f"space, got {seen.shape}; correct the space."
        )
    if not np.isfinite(seen).all():
        raise ValueError(f"env {name!r}: observations must be finite, got {observation}.")
    return seen


def _check_outcome(name: str, reward: Any, terminated: Any, truncated: Any) -> None:
    if not isinstance(reward, (int, float, np.integer, np.floating)):
        raise TypeError(
            f"env {name!r}: the reward must be a number, got a {type(reward).__name__}; use "
            "float()."
        )
    if not np.isfinite(reward):
        raise ValueError(f"env {name!r}: the reward must be finite, got {reward}.")
    for label, value in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(value, (bool, int, np.bool_)):
            raise TypeError(
                f"env {name!r}: {label} must be a bool, got a {type(value).__name__}; use bool()."
            )


def _checked_info(name: str, info: Any) -> dict[str, float]:
    """The numbers in an info; what else is in it does not matter."""
    if not isinstance(info, dict):
        raise TypeError(f"env {name!r}: info must be a dict, got a {type(info).__name__}.")
    numbers = numeric_info(info)
    for key, value in numbers.items():
        if not np.isfinite(value):
            raise ValueError(f"env {name!r}: info[{key!r}] must be finite, got {value}.")
    return numbers


def check_repeats(name: str, first: list[Step], second: list[Step]) -> None:
    """Warn unless two runs from one seed are equal."""
    for one, other in zip(first, second, strict=True):
        if not (
            np.array_equal(one.observation, other.observation)
            and (one.reward, one.terminated, one.info)
            == (other.reward, other.terminated, other.info)
        ):
            warnings.warn(
                f"env {name!r}: the same seed and actions should give the same episodes, but they "
                "differ, so that no run can be repeated; call super().reset(seed=seed) and draw "
                "from self.np_random only.",
                stacklevel=3,
            )
            return


def check_acting(name: str, env: Env, found: Mapping[str, Any], steps: list[Step]) -> None:
    """Check that behaviours that are functions act: at resets of three environments, and later on.

    Args:
        name: What messages call the environment.
        env: The environment, as training sees it.
        found: Its behaviours.
        steps: What it said to random actions, the first a reset.
    """
    native = native_spaces(env)[1]
    told = dict.fromkeys(key for step in steps for key in step.info)
    situations = [_seen([steps[0]] * 3, steps[0].info), _seen(steps[:8], told)]
    for label, what in found.items():
        if not callable(what):
            continue
        checked = CheckedBehaviour(what, name, label, native)
        for situation in situations:
            one, again = _act(checked, situation), _act(checked, situation)
            if not torch.equal(one, again):
                warnings.warn(
                    f"env {name!r}: behaviour {label!r} should take the same actions where it sees "
                    "the same and is given generators of one seed, but they differ, so that no "
                    "data can be repeated; draw from the generator alone.",
                    stacklevel=3,
                )
                break


def _act(behaviour: CheckedBehaviour, shown: TensorDict) -> Tensor:
    behaviour.reset()  # of what it remembers of the episodes that it was in
    return behaviour(shown.clone(), torch.Generator().manual_seed(0))


def _seen(steps: list[Step], names: Iterable[str]) -> TensorDict:
    """What behaviours are shown of steps, ``[B]``; 0 for numbers that one does not tell."""
    about = {key: torch.tensor([step.info.get(key, 0.0) for step in steps]) for key in names}
    shown = torch.from_numpy(np.stack([step.observation for step in steps]))
    return TensorDict({OBSERVATION: shown, INFO: TensorDict(about, len(steps))}, len(steps))


def check_table(name: str, table: Any, env: Env, steps: list[Step]) -> None:
    """Check that a transition table says what stepping does."""
    if not isinstance(table, Table):
        raise TypeError(
            f"env {name!r}: transition_table() must return a popl_rl.data.tables.Table, got a "
            f"{type(table).__name__}."
        )
    count = getattr(env.action_space, "n", None)
    if count != table.next_state.shape[1]:
        raise ValueError(
            f"env {name!r}: transition_table() lists {table.next_state.shape[1]} actions, but "
            f"action_space is {env.action_space}; list every action of a Discrete space."
        )
    first = first_action(env.action_space)
    expected = first + torch.arange(count)
    if not bool((table.steps[ACTION].long() == expected).all()):
        raise ValueError(
            f"env {name!r}: column a of transition_table()'s 'action' must be the environment's "
            f"action {first} + a everywhere, as action_space is {env.action_space}."
        )
    listed = set(table.steps[INFO].keys())
    given = steps[0].info.keys()
    if not {"state", "next_state"} <= given or not given <= listed:
        raise ValueError(
            f"env {name!r}: with a transition table, info must hold 'state' and 'next_state', and "
            f"the table all of info's keys; info has {sorted(given)}, the table {sorted(listed)}."
        )
    current, taken = -1, 0
    for step in steps:
        if step.action is None:
            current, taken = int(step.info["state"]), 0
            if not 0 <= current < len(table.start) or table.start[current] <= 0:
                _disagree(name, f"start gives no probability to the first state {current}")
            continue
        column = int(step.action) - first
        row = table.steps[current, column]
        where = f"at state {current} and action {int(step.action)}"
        after = int(table.next_state[current, column])
        if step.info["state"] != current:
            raise ValueError(
                f"env {name!r}: info['state'] must be the state before the step, {current}, got "
                f"{step.info['state']}."
            )
        if step.info["next_state"] != after:
            _disagree(name, f"next_state is {after} {where}, stepped to {step.info['next_state']}")
        if step.terminated != bool(table.terminal[current, column]):
            _disagree(name, f"terminal is {not step.terminated} {where}, it was {step.terminated}")
        taken += 1
        if table.horizon is not None and step.truncated != (taken >= table.horizon):
            _disagree(
                name, f"horizon is {table.horizon}, truncated was {step.truncated} at {taken}"
            )
        if not np.isclose(step.reward, float(row[REWARD]), atol=1e-5):
            _disagree(name, f"reward is {float(row[REWARD]):g} {where}, got {step.reward:g}")
        if not np.allclose(step.observation, table.steps[OBSERVATION][after, 0], atol=1e-5):
            _disagree(name, f"the observation of state {after} is not the one seen")
        for key, value in step.info.items():
            if not np.isclose(float(value), float(row[INFO, key]), atol=1e-5):
                _disagree(name, f"info {key!r} is {float(row[INFO, key]):g} {where}, got {value}")
        current = after


def _disagree(name: str, what: str) -> None:
    raise ValueError(
        f"env {name!r}: transition_table() must agree with stepping, but {what}; build both from "
        "one function."
    )


def check_torchrl(name: str, env: Env) -> None:
    """Warn unless TorchRL can wrap the environment, which fine-tuning with its losses needs."""
    # TorchRL counts discrete actions from 0 whatever the space says.
    counted = counting_from_zero(env)
    level = logger.level
    logger.setLevel("ERROR")
    try:
        # The check seeds torch's own generator.
        with torch.random.fork_rng(devices=[]):
            check_env_specs(GymWrapper(counted, categorical_action_encoding=True))
    except Exception as error:
        warnings.warn(
            f"env {name!r}: TorchRL's check_env_specs failed with {type(error).__name__}: "
            f"{error} Training does not need it; to use TorchRL's losses, make the spaces describe "
            "what reset and step return.",
            stacklevel=3,
        )
    finally:
        logger.setLevel(level)
