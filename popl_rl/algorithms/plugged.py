"""Selection rules and methods of other people, checked wherever they are called."""

import math
from typing import Any, cast

import torch
from torch import Tensor

from popl_rl.algorithms.problem import Method
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.plug_ins import PlugInError, call, defined, is_foreign, located
from popl_rl.selection.rules import Selection

__all__ = ["checked_method", "checked_selection"]


def checked_selection(rule: Selection, name: str) -> Selection:
    """A rule of selection of other people, whose every choice is checked; one of ours as it is.

    Args:
        rule: The rule.
        name: What messages call it.
    """
    if not is_foreign(rule):
        return rule

    def select(values: Tensor, num_selected: int, *, generator: torch.Generator) -> Tensor:
        doing = f"selecting {num_selected} of values of shape {list(values.shape)}"
        found = call("selection", name, doing, rule, values, num_selected, generator=generator)
        with located(rule):
            _check_parents(name, found, num_selected, len(values))
        return cast("Tensor", found)

    return select


def _check_parents(name: str, found: Any, count: int, members: int) -> None:
    if not isinstance(found, Tensor) or found.dtype != torch.int64 or found.shape != (count,):
        got = f"a {type(found).__name__}"
        if isinstance(found, Tensor):
            got = f"{found.dtype} of shape {list(found.shape)}"
        raise TypeError(
            f"selection {name!r} must return a tensor of int64, [{count}], one row of values for "
            f"each parent, got {got}"
        )
    if found.min() < 0 or found.max() >= members:
        raise ValueError(
            f"selection {name!r} must return rows of values, 0..{members - 1}, got "
            f"{int(found.min())}..{int(found.max())}; values are [member, case]"
        )


def checked_method(method: Any, name: str) -> Method:
    """A method of other people, whose every answer is checked; one of ours as it is.

    Args:
        method: What its factory made.
        name: What messages call it.

    Raises:
        TypeError: If it lacks something that a method has.
    """
    if not is_foreign(method):
        return cast("Method", method)
    with located(type(method)):
        _check_protocol(method, name)
    return cast("Method", _CheckedMethod(method, name))


def _check_protocol(method: Any, name: str) -> None:
    for attribute in ("step", "result", "state_dict", "load_state_dict"):
        if not callable(getattr(method, attribute, None)):
            raise TypeError(
                f"method {name!r} must have a method {attribute}(), but a "
                f"{type(method).__name__} has none; see popl_rl.algorithms.problem.Method"
            )
    for attribute, least in (("generation", 0), ("generations", 1)):
        value = getattr(method, attribute, None)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise TypeError(
                f"method {name!r} must have {attribute}, an int of at least {least}, got {value!r}"
            )
    if not isinstance(getattr(method, "population", None), Population):
        raise TypeError(
            f"method {name!r} must have population, a popl_rl.models.population.Population, got a "
            f"{type(getattr(method, 'population', None)).__name__}"
        )


class _CheckedMethod:
    """See ``checked_method``. Whatever else the method has is to be had here too."""

    def __init__(self, method: Any, name: str) -> None:
        self._method, self._name = method, name
        self._scalars: list[str] | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)

    @property
    def generation(self) -> int:
        """Generations done so far."""
        return cast("int", self._method.generation)

    @property
    def generations(self) -> int:
        """Generations after which it is finished."""
        return cast("int", self._method.generations)

    @property
    def population(self) -> Population:
        """The hypotheses as they are now."""
        return cast("Population", self._method.population)

    def step(self) -> dict[str, float]:
        """Run one generation."""
        done = self.generation
        said = self._call(f"generation {done + 1}", "step")
        if not isinstance(said, dict) or not all(isinstance(key, str) for key in said):
            got = type(said).__name__
            raise self._fault(f"step() must return a dict of scalars by name, got a {got}")
        if self.generation != done + 1:
            came = f"{self.generation} after {done + 1} generations"
            raise self._fault(f"step() must raise generation by 1, got {came}")
        odd = [key for key, value in said.items() if not isinstance(value, int | float)]
        if odd:
            raise self._fault(f"step() must return numbers, got others for {', '.join(odd)}")
        worst = said.get("worst_rater_accuracy", math.nan)
        if not 0 <= worst <= 1:
            came = f"{said.get('worst_rater_accuracy')} among {sorted(said)}"
            raise self._fault(f"step() must return worst_rater_accuracy, in [0, 1], got {came}")
        names = self._scalars = self._scalars or list(said)
        if set(names) != set(said):
            came = f"{sorted(names)} and then {sorted(said)}"
            raise self._fault(f"step() must return the same scalars each time, got {came}")
        return said

    def result(self) -> HypothesisSet:
        """The set that has been found."""
        found = self._call("result()", "result")
        if not isinstance(found, HypothesisSet) or not len(found):
            got = type(found).__name__
            raise self._fault(f"result() must return a set of hypotheses, got a {got}")
        values = found.population.plain().members.data.values(True, True)
        if not all(bool(value.isfinite().all()) for value in values):
            raise self._fault("result() must hold finite parameters, got NaN or infinite ones")
        if not 0 < found.alpha < math.inf:
            raise self._fault(f"result() must have a positive alpha, got {found.alpha}")
        return found

    def state_dict(self) -> dict[str, Any]:
        """Everything the next generation depends on."""
        state = self._call("state_dict()", "state_dict")
        if not isinstance(state, dict):
            raise self._fault(f"state_dict() must return a dict, got a {type(state).__name__}")
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self._call("load_state_dict()", "load_state_dict", state)

    def _call(self, doing: str, attribute: str, *arguments: Any) -> Any:
        function = getattr(self._method, attribute)
        return call("method", self._name, doing, function, *arguments)

    def _fault(self, said: str) -> PlugInError:
        place = defined(type(self._method))
        return PlugInError(f"method {self._name!r}: {said}{f' ({place})' if place else ''}")
