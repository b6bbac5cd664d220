"""Simulated raters: what each hidden group wants, how its people answer, and who belongs to it.

Only data gathering and evaluation import this module; a learner never does.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl import planning, registry
from popl_rl.keys import ACTION, INFO, OBSERVATION, Answer

__all__ = ["Label", "RaterGroup", "Raters", "Response", "Utility", "make_groups"]

Utility: TypeAlias = Callable[[TensorDictBase], Tensor]
"""Segments of batch size ``[B, T]`` -> the utility of each step, float ``[B, T]``."""
Label: TypeAlias = Literal["regret", "return"]

_EQUAL = 1e-6


@dataclass(frozen=True)
class Response:
    """How a rater answers once both segments have a worth.

    The response model of B-Pref (Lee et al., 2021, arXiv 2111.03026).

    The order is B-Pref's: skip, equal, rational choice, mistake. It differs in four points: every
    threshold is compared with the myopic sum, which is what the rater perceives, where B-Pref takes
    the plain sum for skips and ties; thresholds are absolute instead of scaled by recent returns; a
    greedy rater calls a tie when the sums are equal, where B-Pref then prefers the first; and
    greedy is ``rationality=inf`` instead of a negative number.

    Attributes:
        rationality: β of P(second) = sigmoid(β (worth of second − worth of first)); infinite always
            prefers the better one, 0 answers at random.
        mistake: Probability of saying the opposite. Ties and skips are never mistaken.
        myopia: γ of the weights γ^(T−1−t): below 1 the last steps count most.
        tie: Answers TIE when the worths differ by at most this. 0 means equal up to rounding (1e-6,
            relative above 1).
        skip: Answers SKIP when both worths are at most this; None never skips.

    Raises:
        ValueError: If a value is out of its range.
    """

    rationality: float = math.inf
    mistake: float = 0.0
    myopia: float = 1.0
    tie: float = 0.0
    skip: float | None = None

    def __post_init__(self) -> None:
        # Written so that NaN fails too.
        if not self.rationality >= 0:
            raise ValueError(
                f"rationality must be at least 0 (inf is greedy), got {self.rationality}."
            )
        if not 0 <= self.mistake <= 1:
            raise ValueError(f"mistake must be a probability in [0, 1], got {self.mistake}.")
        if not 0 < self.myopia <= 1:
            raise ValueError(
                f"myopia must be in (0, 1] (1 weighs all steps alike), got {self.myopia}."
            )
        if not 0 <= self.tie < math.inf:
            raise ValueError(f"tie must be finite and at least 0, got {self.tie}.")
        if self.skip is not None and not math.isfinite(self.skip):
            raise ValueError(f"skip must be finite, or None for never, got {self.skip}.")

    def answer(self, sums: Tensor, generator: torch.Generator) -> Tensor:
        """Answer pairs.

        The generator is used alike whatever the sums are.

        Args:
            sums: ``[M, 2]`` float, the (myopic) worth of both segments of each pair.
            generator: Source of randomness, on the device of ``sums``.

        Returns:
            ``[M]`` int64, each an :class:`~popl_rl.keys.Answer`.

        Raises:
            ValueError: If ``sums`` is of another shape or not finite.
        """
        if sums.ndim != 2 or sums.shape[1] != 2:
            raise ValueError(f"sums must have shape [pairs, 2], got {list(sums.shape)}.")
        if not bool(sums.isfinite().all()):
            raise ValueError("sums must be finite, got NaN or infinite worths.")
        sums = sums.double()
        draws = torch.rand(sums.shape, generator=generator, device=sums.device, dtype=sums.dtype)
        difference = sums[:, 1] - sums[:, 0]
        if math.isinf(self.rationality):
            second = difference > 0
        else:
            second = draws[:, 0] < torch.sigmoid(self.rationality * difference)
        second = second ^ (draws[:, 1] < self.mistake)
        answers = torch.where(second, int(Answer.SECOND), int(Answer.FIRST))
        rounding = _EQUAL * sums.abs().amax(1).clamp(min=1)
        answers[difference.abs() <= rounding.clamp(min=self.tie)] = int(Answer.TIE)
        if self.skip is not None:
            answers[sums.amax(1) <= self.skip] = int(Answer.SKIP)
        return answers


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
        value: What a state is worth, observations ``[..., O]`` -> ``[...]``, for label="regret"
            elsewhere; see :func:`popl_rl.values.with_values`. None for "return", as ``advantages``.

    Raises:
        ValueError: If ``label`` is neither, or ``advantages`` and ``value`` do not go with it.
    """

    name: str
    utility: Utility
    response: Response
    label: Label = "return"
    advantages: Tensor | None = None
    value: Callable[[Tensor], Tensor] | None = None

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
        """Return the utility of each step, float ``[B, T]``, checked.

        Args:
            segments: TensorDict of batch size ``[B, T]``; the ``[S, A]`` steps of a table will do.

        Raises:
            TypeError: If the rater's function returns no floating-point tensor.
            ValueError: If it fails, or its result has another shape or is not finite.
        """
        try:
            result = self.utility(segments)
        except Exception as error:
            raise ValueError(
                f"rater {self.name!r} failed on segments of batch size "
                f"{list(segments.batch_size)} with {type(error).__name__}: {error}"
            ) from error
        if not isinstance(result, Tensor):
            raise TypeError(
                f"rater {self.name!r} must return a float tensor of shape "
                f"{list(segments.batch_size)}, got a {type(result).__name__}."
            )
        if result.shape != segments.batch_size:
            raise ValueError(
                f"rater {self.name!r} must return one utility per step, shape "
                f"{list(segments.batch_size)}, got shape {list(result.shape)}"
                f"{_shape_cure(result, segments)}."
            )
        if not result.is_floating_point():
            raise TypeError(
                f"rater {self.name!r} must return floats, got {result.dtype}; call .float() on it."
            )
        if not bool(result.isfinite().all()):
            raise ValueError(
                f"rater {self.name!r} must return finite numbers, got "
                f"{int((~result.isfinite()).sum())} NaN or infinite of {result.numel()}."
            )
        return result

    def judge(self, segments: TensorDictBase) -> Tensor:
        """Return the worth of each step by which this group compares, float ``[N, T]``.

        That is its utility (label="return") or the advantage of the action taken
        (label="regret"). With a table of optimal advantages, segments must hold ``("info",
        "state")`` and a discrete ``action``. With the value V of a state it is
        ``u_t + V(s_{t+1}) - V(s_t)``, and 0 for the last step, after which no state is known: in
        sum ``sum u + V(s_T) - V(s_0)``.

        Raises:
            ValueError: As :meth:`step_utility`, or if segments do not say which state each step was
                taken in.
            TypeError: As :meth:`step_utility`.
        """
        if self.value is not None:
            worth = self.value(segments[OBSERVATION])
            gained = self.step_utility(segments)[:, :-1] + worth.diff(dim=1)
            return torch.nn.functional.pad(gained, (0, 1))
        if self.advantages is None:
            return self.step_utility(segments)
        if (INFO, "state") not in segments.keys(include_nested=True):
            raise ValueError(
                f"rater {self.name!r} labels by regret, which needs ('info', 'state') in segments; "
                "let the environment's info hold 'state', or use label='return'."
            )
        state, action = segments[INFO, "state"].long(), segments[ACTION].long()
        states, actions = self.advantages.shape
        if state.shape != action.shape:
            raise ValueError(
                f"rater {self.name!r} labels by regret, which needs discrete actions of shape "
                f"{list(state.shape)}, got {list(action.shape)}; use label='return'."
            )
        if bool((state < 0).any() | (state >= states).any() | (action >= actions).any()):
            raise ValueError(
                f"rater {self.name!r} knows {states} states and {actions} actions, got state "
                f"{int(state.max())} and action {int(action.max())}; take segments and transition "
                "table from the same environment."
            )
        return self.advantages.to(state.device)[state, action]

    def worth(self, segments: TensorDictBase) -> Tensor:
        """Return each segment's worth to this group, float32 ``[N]``: the myopic sum of its steps.

        Raises:
            ValueError: As :meth:`judge`.
            TypeError: As :meth:`judge`.
        """
        # Summed in float64: two segments with the same steps in another order must come out equal.
        steps = self.judge(segments).double()
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
        references: One per group: a reference (see :mod:`popl_rl.registry`) or the function itself.
            A group is called by what follows ':', by its registered name, or by the function's
            name.
        label: What groups compare, "regret" or "return"; see :class:`RaterGroup`.
        table: The environment's transitions, needed for "regret".
        response: How people answer: one for all groups, or one per group. None always answers
            rightly.
        discount: For "regret": discount of the optimal advantages.
        temperature: For "regret": entropy weight of the optimal advantages; 0 is the hard maximum.

    Raises:
        ValueError: If there are no references, one cannot be resolved, two groups would have the
            same name, label="regret" comes without a table, or the number of responses differs; and
            as :meth:`RaterGroup.step_utility`.
        TypeError: If ``references`` is a single string, or as :meth:`RaterGroup.step_utility`.
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
            advantages = None
            if table is not None:
                reward = group.step_utility(table.steps).double()
                advantages, _ = planning.solve(
                    table, reward, discount=discount, temperature=temperature
                )
            group = RaterGroup(name, utility, own, label, advantages)
        groups.append(group)
    return tuple(groups)


@dataclass(frozen=True, eq=False)
class Raters:
    """Individuals, each of one hidden group.

    Attributes:
        groups: The groups.
        group_of: ``[R]`` int64, the group of each rater; a rater's id is its position.
            ``len()`` counts raters.

    Raises:
        ValueError: If there are no groups or raters, or a rater's group does not exist.
    """

    groups: tuple[RaterGroup, ...]
    group_of: Tensor

    def __post_init__(self) -> None:
        if not self.groups:
            raise ValueError("groups must hold at least one rater group, got none.")
        if self.group_of.ndim != 1 or not len(self.group_of):
            raise ValueError(
                "group_of must have shape [raters] with at least one, got "
                f"{list(self.group_of.shape)}."
            )
        low, high = int(self.group_of.min()), int(self.group_of.max())
        if low < 0 or high >= len(self.groups):
            raise ValueError(
                f"group_of must lie in 0..{len(self.groups) - 1}, got values from {low} to {high}."
            )

    @classmethod
    def draw(
        cls,
        groups: Sequence[RaterGroup],
        *,
        num_raters: int,
        shares: Sequence[float] | None = None,
        generator: torch.Generator,
    ) -> "Raters":
        """Draw raters, each independently of a group with probability ``shares``.

        A group with a positive share that came out empty then takes one rater (the last) from the
        group that has most, so that every such group has somebody, as long as there are as many
        raters as groups.

        Args:
            groups: The groups.
            num_raters: Number of raters, at least 1.
            shares: Probability of each group, summing to 1. None makes all groups equally likely.
            generator: Source of randomness.

        Raises:
            ValueError: If ``num_raters`` is below 1 or ``shares`` are no probabilities of the
                groups.
        """
        if not groups:
            raise ValueError("groups must hold at least one rater group, got none.")
        if num_raters < 1:
            raise ValueError(f"num_raters must be at least 1, got {num_raters}.")
        wanted = [1 / len(groups)] * len(groups) if shares is None else [float(s) for s in shares]
        if len(wanted) != len(groups):
            raise ValueError(
                f"shares must have one value per group: {len(groups)} groups "
                f"({', '.join(group.name for group in groups)}), got {len(wanted)} shares."
            )
        if not all(share >= 0 for share in wanted) or not abs(sum(wanted) - 1) <= 1e-6:
            raise ValueError(
                f"shares must be at least 0 and sum to 1, got {wanted} with sum {sum(wanted):g}."
            )
        weights = torch.tensor(wanted, dtype=torch.float64, device=generator.device)
        group_of = torch.multinomial(weights, num_raters, replacement=True, generator=generator)
        if num_raters >= len(groups):
            for index, share in enumerate(wanted):
                if share > 0 and not bool((group_of == index).any()):
                    largest = group_of.bincount(minlength=len(groups)).argmax()
                    group_of[(group_of == largest).nonzero()[-1]] = index
        return cls(tuple(groups), group_of)

    def __len__(self) -> int:
        return len(self.group_of)

    def worth(self, segments: TensorDictBase) -> Tensor:
        """Return what each segment is worth to each group, float32 ``[G, N]``.

        Raises:
            ValueError: As :meth:`RaterGroup.judge`.
            TypeError: As :meth:`RaterGroup.judge`.
        """
        return torch.stack([group.worth(segments) for group in self.groups])

    def answer(
        self, pairs: Tensor, rater: Tensor, worth: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Answer pairs, each as the rater who is asked would.

        Args:
            pairs: ``[M, 2]`` int64, rows of the two segments.
            rater: ``[M]`` int64, who is asked.
            worth: ``[G, N]`` float, what each segment is worth to each group, from :meth:`worth`.
            generator: Source of randomness, on the device of ``worth``.

        Returns:
            ``[M]`` int64, each an :class:`~popl_rl.keys.Answer`.

        Raises:
            ValueError: If shapes do not fit together.
        """
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ValueError(f"pairs must have shape [pairs, 2], got {list(pairs.shape)}.")
        if rater.shape != pairs.shape[:1]:
            raise ValueError(
                f"rater must have shape [{len(pairs)}], one per pair, got {list(rater.shape)}."
            )
        if worth.ndim != 2 or len(worth) != len(self.groups):
            raise ValueError(
                f"worth must have shape [{len(self.groups)} groups, segments], got "
                f"{list(worth.shape)}."
            )
        group = self.group_of.to(rater.device)[rater]
        sums = worth[group.unsqueeze(1), pairs]
        answers = torch.empty_like(rater)
        for index, member in enumerate(self.groups):
            asked = group == index
            answers[asked] = member.response.answer(sums[asked], generator)
        return answers


def _named(reference: str | Utility) -> tuple[str, Utility]:
    if isinstance(reference, str):
        return reference.rpartition(":")[2], registry.resolve("rater", reference)
    if not callable(reference):
        raise TypeError(
            f"a rater must be a reference or a function, got a {type(reference).__name__}."
        )
    return getattr(reference, "__name__", type(reference).__name__), reference


def _shape_cure(result: Tensor, segments: TensorDictBase) -> str:
    if result.ndim > 2 and result.shape[:2] == segments.batch_size:
        return "; reduce the last dimension, as in .sum(-1)"
    if result.shape == segments.batch_size[:1]:
        return "; give each step its utility instead of one number per segment"
    return ""
