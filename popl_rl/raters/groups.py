"""Simulated raters: what each hidden group wants, how its people answer, and who belongs to it.

Only data gathering and evaluation import this module; a learner never does.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl import registry
from popl_rl.data import tables as planning
from popl_rl.keys import ACTION, HIDDEN, INFO, OBSERVATION
from popl_rl.plug_ins import PlugInError, call, located
from popl_rl.raters.checks import checked
from popl_rl.raters.response import Response

__all__ = ["Label", "RaterGroup", "Utility", "make_groups"]

Utility: TypeAlias = Callable[[TensorDictBase], Tensor]
"""Segments of batch size ``[B, T]`` -> the utility of each step, float ``[B, T]``."""
Label: TypeAlias = Literal["regret", "return"]


@dataclass(frozen=True, eq=False)
class RaterGroup:
    """People who want the same: a hidden context.

    Attributes:
        name: What reports call the group.
        utility: Segments ``[B, T]`` -> utility of each step ``[B, T]``.
        response: How its people answer.
        label: "return" compares sums of utility; "regret" compares sums of optimal advantages, the
            assumption that CPL (arXiv 2310.13639) is derived from.
        advantages: ``[S, A]`` optimal advantages of the utility, for label="regret" where the
            environment has a transition table.
        first_action: The action of the first column of ``advantages``.
        value: What a state is worth, observations ``[..., O]`` -> ``[...]``, for label="regret"
            elsewhere; see ``popl_rl.raters.values.with_values``. None for "return", as
            ``advantages``.

    Raises:
        ValueError: If ``label`` is neither, or ``advantages`` and ``value`` do not go with it.
    """

    name: str
    utility: Utility
    response: Response
    label: Label = "return"
    advantages: Tensor | None = None
    value: Callable[[Tensor], Tensor] | None = None
    first_action: int = 0

    def __post_init__(self) -> None:
        if self.label not in ("regret", "return"):
            raise ValueError(f"label must be 'regret' or 'return', got {self.label!r}.")
        given = [name for name in ("advantages", "value") if getattr(self, name) is not None]
        if len(given) != (self.label == "regret"):
            raise ValueError(
                f"rater {self.name!r}: label='regret' needs either advantages [states, actions] or "
                f"the value of a state, and label='return' none of them, got label={self.label!r} "
                f"with {' and '.join(given) or 'no advantages'}; make_groups() computes advantages "
                "from a transition table, with_values() fits values to segments."
            )

    def step_utility(self, segments: TensorDictBase) -> Tensor:
        """Return the utility of each step, float32 ``[B, T]``, checked.

        Args:
            segments: TensorDict of batch size ``[B, T]``; the ``[S, A]`` steps of a table will do.

        Raises:
            TypeError: If the rater's function returns no floating-point tensor.
            ValueError: If it fails, or its result has another shape or is not finite.
        """
        doing = f"judging segments of batch size {list(segments.batch_size)}"
        try:
            result = call("rater", self.name, doing, self.utility, segments)
        except PlugInError as error:
            if not isinstance(error.__cause__, KeyError):
                raise
            raise PlugInError(f"{error}; {_held(segments)}") from error.__cause__
        with located(self.utility):
            return checked(result, segments, rater=self.name)

    def perceived_utility(self, segments: TensorDictBase) -> Tensor:
        """Return the worth of each step by which this group compares, float ``[N, T]``.

        That is its utility (label="return") or the advantage of the action taken
        (label="regret"). With a table of optimal advantages, segments must hold ``("info",
        "state")`` and a discrete ``action``. With the value V of a state it is
        ``u_t + V(s_{t+1}) - V(s_t)``, and 0 for the last step, after which no state is known: in
        sum ``sum u + V(s_T) - V(s_0)``.

        Raises:
            ValueError: As ``step_utility``, or if segments do not say which state each step was
                taken in.
            TypeError: As ``step_utility``.
        """
        if self.value is not None:
            segment_utility = self.value(segments[OBSERVATION])
            gained = self.step_utility(segments)[:, :-1] + segment_utility.diff(dim=1)
            return torch.nn.functional.pad(gained, (0, 1))
        if self.advantages is None:
            return self.step_utility(segments)
        if (INFO, "state") not in segments.keys(include_nested=True):
            raise ValueError(
                f"rater {self.name!r} labels by regret, which needs ('info', 'state') in segments; "
                "let the environment's info hold 'state', or use label='return'."
            )
        state, action = segments[INFO, "state"].long(), segments[ACTION].long() - self.first_action
        states, actions = self.advantages.shape
        if state.shape != action.shape:
            raise ValueError(
                f"rater {self.name!r} labels by regret, which needs discrete actions of shape "
                f"{list(state.shape)}, got {list(action.shape)}; use label='return'."
            )
        strange = (state < 0) | (state >= states) | (action < 0) | (action >= actions)
        if bool(strange.any()):
            raise ValueError(
                f"rater {self.name!r} knows {states} states and {actions} actions, got state "
                f"{int(state[strange][0])} and the action of number {int(action[strange][0])}, "
                "counted from 0; take segments and transition table from the same environment."
            )
        return self.advantages.to(state.device)[state, action]

    def segment_utility(self, segments: TensorDictBase) -> Tensor:
        """Return each segment's worth to this group, float32 ``[N]``: the myopic sum of its steps.

        Raises:
            ValueError: As ``perceived_utility``.
            TypeError: As ``perceived_utility``.
        """
        # Summed in float64: two segments with the same steps in another order must come out equal.
        steps = self.perceived_utility(segments).double()
        length = steps.shape[1]
        age = torch.arange(length - 1, -1, -1, device=steps.device, dtype=steps.dtype)
        return (steps * self.response.myopia**age).sum(1).float()


def make_groups(
    references: Sequence[str | Utility],
    *,
    label: Label = "regret",
    table: planning.Table | None = None,
    response: Response | Sequence[Response] | None = None,
    discount: float = 0.97,
    temperature: float = 0.0,
) -> tuple[RaterGroup, ...]:
    """Make rater groups from references or functions.

    Args:
        references: One per group: a reference (see ``popl_rl.registry``) or the function itself. A
            group is called by what follows ':', by its registered name, or by the function's name.
        label: What groups compare, "regret" or "return"; see ``RaterGroup``.
        table: The environment's transitions, needed for "regret".
        response: How people answer: one for all groups, or one per group. None always answers
            rightly.
        discount: For "regret": discount of the optimal advantages.
        temperature: For "regret": entropy weight of the optimal advantages; 0 is the hard maximum.

    Raises:
        ValueError: If there are no references, one cannot be resolved, two groups would have the
            same name, label="regret" comes without a table, or the number of responses differs; and
            as ``RaterGroup.step_utility``.
        TypeError: If ``references`` is a single string, or as ``RaterGroup.step_utility``.
    """
    if isinstance(references, str):
        raise TypeError(
            f"references must be a list of references, got {references!r}; write [...]."
        )
    if not references:
        raise ValueError("references must name at least one rater group, got none.")
    if label == "regret" and table is None:
        raise ValueError(
            "label='regret' needs the environment's transition table, and this environment exposes "
            "none (no transition_table()); use label='return'."
        )
    if response is None or isinstance(response, Response):
        responses = [response or Response()] * len(references)
    else:
        responses = list(response)
    if len(responses) != len(references):
        raise ValueError(
            f"response must be one for all or one per group: {len(references)} groups, got "
            f"{len(responses)} responses."
        )
    origin: dict[str, str | Utility] = {}
    groups = []
    for reference, own in zip(references, responses, strict=True):
        name, utility = _named(reference)
        if name in origin:
            raise ValueError(
                f"two rater groups are called {name!r}: {origin[name]!r} and {reference!r}; rename "
                "one of the functions."
            )
        origin[name] = reference
        group = RaterGroup(name, utility, own, "return")
        if label != "return":
            # Past the check above a table is there unless the label is wrong, which RaterGroup
            # reports.
            advantages, first = None, 0
            if table is not None:
                first = int(table.steps[ACTION][0, 0])
                reward = group.step_utility(table.steps).double()
                advantages, _ = planning.solve(
                    table, reward, discount=discount, temperature=temperature
                )
            group = RaterGroup(name, utility, own, label, advantages, first_action=first)
        groups.append(group)
    return tuple(groups)


def _held(segments: TensorDictBase) -> str:
    """What raters may read, in words: a name that they miss is misspelt, or no info says it."""
    told = [str(name) for name in segments.get(INFO, {}).keys()]  # noqa: SIM118 - no dict
    read = [str(name) for name in segments.keys() if name not in (INFO, HIDDEN)]  # noqa: SIM118
    return f"segments hold {', '.join(read)}, and in info {', '.join(told) or 'nothing'}"


def _named(reference: str | Utility) -> tuple[str, Utility]:
    if isinstance(reference, str):
        name = reference.rpartition(":")[2].replace(" ", "")
        return name, registry.resolve("rater", reference)
    if not callable(reference):
        raise TypeError(
            f"a rater must be a reference or a function, got a {type(reference).__name__}."
        )
    return getattr(reference, "__name__", type(reference).__name__), reference
