"""Transition tables of deterministic environments, found by trying every action in every state."""

from collections import deque
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.data.tables import Table
from popl_rl.keys import ACTION, INFO, OBSERVATION, REWARD

__all__ = ["Enumeration", "Outcome", "enumerate_states"]

State = TypeVar("State", bound=Hashable)


class Outcome(NamedTuple, Generic[State]):
    """What an action does.

    Attributes:
        state: The state after it.
        terminal: Whether the episode is over.
        reward: The environment's own.
        info: Numbers that raters may go by, the same names for every action.
    """

    state: State
    terminal: bool = False
    reward: float = 0.0
    info: Mapping[str, float] = {}


@dataclass(frozen=True, eq=False)
class Enumeration(Generic[State]):
    """Every state that can be reached, and what each action does there.

    Attributes:
        states: The S states; their positions are the numbers in ``("info", "state")``.
        index: Position of each state.
        start: ``[S]`` probabilities of the first state.
        next_state: ``[S, A]`` int64, position of the state after each action.
        terminal: ``[S, A]`` bool, whether it ends the episode.
        reward: ``[S, A]`` float32.
        info: Numbers of each step by name, ``[S, A]``: int64 where all are whole numbers (``int``
            or ``bool``), else float32.
    """

    states: list[State]
    start: Tensor
    next_state: Tensor
    terminal: Tensor
    reward: Tensor
    info: dict[str, Tensor]
    index: dict[State, int] = field(repr=False)

    def table(self, observation: Tensor, *, first_action: int = 0) -> Table:
        """The transition table.

        Args:
            observation: What is seen in each state, ``[S, O]``.
            first_action: The environment's number of the first action, the start of its space.

        Raises:
            ValueError: If there is not one observation for each state.
        """
        states, actions = self.next_state.shape
        if observation.ndim != 2 or len(observation) != states:
            raise ValueError(
                f"observation must be [{states}, features], one for each state, got "
                f"{list(observation.shape)}."
            )
        shape = (states, actions)
        own = torch.arange(states).unsqueeze(1).expand(shape).contiguous()
        steps = TensorDict(
            {
                OBSERVATION: observation.float().unsqueeze(1).expand(*shape, -1).contiguous(),
                ACTION: (first_action + torch.arange(actions)).expand(shape).contiguous(),
                REWARD: self.reward,
                INFO: {"state": own, "next_state": self.next_state, **self.info},
            },
            batch_size=shape,
        )
        return Table(steps, self.next_state, self.terminal, self.start)


def enumerate_states(
    start: Mapping[State, float],
    num_actions: int,
    step: Callable[[State, int], Outcome[State]],
    *,
    most: int = 20_000,
) -> Enumeration[State]:
    """Find all states that can be reached, breadth-first.

    Nothing is tried in states that are reached by terminal steps alone: every action leaves them as
    they are, ends the episode, and is worth nothing.

    Args:
        start: Chance of each first state; positive, in any scale.
        num_actions: Number of actions A, which are 0 to A - 1.
        step: What an action does in a state. It must depend on nothing else, and be the same each
            time.
        most: States at which to give up.

    Raises:
        ValueError: If there is no first state, a chance is not positive, there are more than
            ``most`` states, or steps differ in the names of their numbers.
    """
    if not start or not all(chance > 0 for chance in start.values()):
        raise ValueError(f"start must give a positive chance to each first state, got {start}.")
    index = {state: number for number, state in enumerate(start)}
    states, waiting = list(start), deque(range(len(start)))
    queued = set(waiting)
    outcomes: dict[int, list[Outcome[State]]] = {}
    while waiting:
        number = waiting.popleft()
        outcomes[number] = [step(states[number], action) for action in range(num_actions)]
        for outcome in outcomes[number]:
            if outcome.state not in index:
                index[outcome.state] = len(states)
                states.append(outcome.state)
            after = index[outcome.state]
            if not outcome.terminal and after not in queued:
                queued.add(after)
                waiting.append(after)
        if len(states) > most:
            raise ValueError(
                f"more than {most} states can be reached: take a smaller environment or fewer "
                "layouts, or raise most."
            )
    names = list(next(iter(outcomes.values()))[0].info)
    nothing = dict.fromkeys(names, 0)
    rows = [
        outcomes.get(number, [Outcome(state, True, 0.0, nothing)] * num_actions)
        for number, state in enumerate(states)
    ]
    for row in rows:
        for outcome in row:
            if list(outcome.info) != names:
                raise ValueError(
                    f"info must hold the same numbers at every step, got {list(outcome.info)} and "
                    f"{names}."
                )
    chance = torch.zeros(len(states))
    chance[: len(start)] = torch.tensor([float(value) for value in start.values()])
    return Enumeration(
        states,
        chance / chance.sum(),
        torch.tensor([[index[outcome.state] for outcome in row] for row in rows]),
        torch.tensor([[outcome.terminal for outcome in row] for row in rows]),
        torch.tensor([[float(outcome.reward) for outcome in row] for row in rows]),
        {
            name: _column([[outcome.info[name] for outcome in row] for row in rows])
            for name in names
        },
        index,
    )


def _column(values: list[list[float]]) -> Tensor:
    whole = all(isinstance(value, int) for row in values for value in row)
    return torch.tensor(values, dtype=torch.int64 if whole else torch.float32)
