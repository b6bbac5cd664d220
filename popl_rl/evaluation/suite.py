"""What a benchmark compares: scenarios, methods and the axes on which scenarios lie."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from popl_rl.evaluation.method_names import method_name, sort_key

__all__ = ["Scenario", "Suite"]


@dataclass(frozen=True)
class Scenario:
    """Conditions that methods are compared under.

    Attributes:
        name: Name, also of a folder.
        overrides: Overrides of ``popl-train``.
        methods: Names of the methods that it runs.
        at: Value on each axis of the suite that it lies on.
        data_of: Scenario whose data and baselines it uses; None to make its own.
    """

    name: str
    overrides: tuple[str, ...]
    methods: tuple[str, ...]
    at: Mapping[str, float | str]
    data_of: str | None = None


@dataclass(frozen=True)
class Suite:
    """Scenarios and methods, see the top of ``configs/suites/smoke.yaml``.

    Attributes:
        name: Name.
        scenarios: Scenarios by name.
        methods: Overrides of ``popl-train`` by name of a method.
        overrides: Overrides of every cell.
        seeds: How many seeds, where the command does not say.
    """

    name: str
    scenarios: Mapping[str, Scenario]
    methods: Mapping[str, tuple[str, ...]]
    overrides: tuple[str, ...] = ()
    seeds: int = 5

    def axes(self) -> dict[str, dict[str, float | str]]:
        """Value of each scenario on each axis, in the order of numeric values."""
        found: dict[str, dict[str, float | str]] = {}
        for scenario in self.scenarios.values():
            for axis, value in scenario.at.items():
                found.setdefault(axis, {})[scenario.name] = value
        for axis, points in found.items():
            if not any(isinstance(value, str) for value in points.values()):
                found[axis] = dict(sorted(points.items(), key=lambda point: float(point[1])))
        return found

    def label(self, method: str, choice: str = "") -> str:
        """Name to print for a method of the results, and how its members were chosen."""
        if method not in self.methods:
            return method_name(method, choice)
        return f"{method}, by lexicase" if choice == "lexicase" else method

    def ordered(self, found: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
        """Methods and choices of the results in the order to show them in.

        The suite's own methods come first, each with its choices beside each other; all others keep
        their order.
        """
        own = list(self.methods)
        places = {
            entry: (own.index(entry[0]), sort_key(*entry)[1]) if entry[0] in own else (len(own), 0)
            for entry in found
        }
        return sorted(found, key=places.__getitem__)
