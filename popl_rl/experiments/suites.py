"""Suites: what a benchmark compares, as read from YAML and checked."""

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from popl_rl.evaluation.method_names import METHODS
from popl_rl.evaluation.suite import Scenario, Suite

__all__ = ["load_suite", "parse_suite"]

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")
# Settings that the benchmark makes itself.
_OURS = (
    "seed",
    "run_dir",
    "resume",
    "logger",
    "threads",
    "workers",
    "data.load",
    "data.save",
    "evaluation.baselines_from",
    "hydra",
)
# Methods see the same data and are judged alike.
_SHARED = ("env", "raters", "data", "evaluation")
_DATA = ("env", "raters", "data")


def load_suite(reference: str, *, folder: Traversable) -> Suite:
    """Read a suite.

    Args:
        reference: Name of a YAML file in ``folder``, without its ending, or path of any other.
        folder: Where the suites are that have names.

    Raises:
        ValueError: If there is none, or it has problems.
    """
    files = [entry for entry in folder.iterdir() if entry.name.endswith(".yaml")]
    named = {entry.name.removesuffix(".yaml"): entry for entry in files}
    source = named.get(reference, Path(reference))
    if not source.is_file():
        problem = _unknown("suite", reference, sorted(named))
        raise ValueError(f"{problem}, or a YAML file such as mine.yaml")
    try:
        content = OmegaConf.to_container(OmegaConf.create(source.read_text(encoding="utf-8")))
    except Exception as error:  # OmegaConf passes on whatever its YAML reader raises
        raise ValueError(f"suite {reference!r} is not valid YAML: {error}") from error
    return parse_suite(source.name.removesuffix(".yaml"), content)


def parse_suite(name: str, definition: object) -> Suite:
    """Check what a suite's YAML says and make a suite of it.

    Args:
        name: Name of the suite.
        definition: What the file holds.

    Raises:
        ValueError: Listing every problem, each with its key.
    """
    problems: list[str] = []
    content = _mapping(definition, "the suite", problems)
    _known(content, "the suite", ("overrides", "seeds", "scenarios", "methods"), problems)
    methods: dict[str, tuple[str, ...]] = {}
    for method, listed in _named(content, "methods", problems):
        where = f"methods.{method}"
        methods[method] = _overrides(listed, where, (*_OURS, *_SHARED), problems)
    for method in [name for name in methods if name in METHODS and METHODS[name].is_reference]:
        problems.append(f"methods.{method} has the name of other rows of results.csv; rename it")
    scenarios: dict[str, Scenario] = {}
    for scenario, details in _named(content, "scenarios", problems):
        scenarios[scenario] = _scenario(scenario, details, list(methods), problems)
    for made in scenarios.values():
        _check_data_of(made, scenarios, problems)
    _check_distinct(list(scenarios.values()), problems)
    seeds = content.get("seeds", 5)
    if not isinstance(seeds, int) or isinstance(seeds, bool) or seeds < 1:
        problems.append(f"seeds must be a number of at least 1, got {seeds!r}")
    overrides = _overrides(content.get("overrides", []), "overrides", _OURS, problems)
    if problems:
        raise ValueError(f"suite {name!r} has problems:\n  " + "\n  ".join(problems))
    return Suite(name, scenarios, methods, overrides, seeds)


def _scenario(name: str, details: object, methods: list[str], problems: list[str]) -> Scenario:
    where = f"scenarios.{name}"
    if not isinstance(details, Mapping):
        details = {"overrides": details}
    _known(details, where, ("overrides", "at", "methods", "data_of"), problems)
    overrides = _overrides(details.get("overrides", []), f"{where}.overrides", _OURS, problems)
    at = _mapping(details.get("at", {}), f"{where}.at", problems)
    for axis, value in at.items():
        if not _NAME.fullmatch(str(axis)):
            problems.append(f"{where}.at: {axis!r} does not do as the name of an axis")
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            problems.append(f"{where}.at.{axis} must be a number or a word, got {value!r}")
    only = details.get("methods", methods)
    if not isinstance(only, list) or not only:
        problems.append(f"{where}.methods must be a list of methods, got {only!r}")
        only = methods
    for method in only:
        if method not in methods:
            problems.append(f"{where}.methods: {_unknown('method', method, methods)}")
    # In the suite's own order, so that the first method makes the data everywhere.
    chosen = tuple(method for method in methods if method in only)
    data_of = details.get("data_of")
    return Scenario(name, overrides, chosen, at, None if data_of is None else str(data_of))


def _check_data_of(
    scenario: Scenario, scenarios: Mapping[str, Scenario], problems: list[str]
) -> None:
    if scenario.data_of is None:
        return
    where = f"scenarios.{scenario.name}.data_of"
    if scenario.data_of not in scenarios:
        problems.append(f"{where}: {_unknown('scenario', scenario.data_of, list(scenarios))}")
    elif scenarios[scenario.data_of].data_of is not None or scenario.data_of == scenario.name:
        problems.append(f"{where} must name a scenario that makes its own data")
    without = [name for name in scenario.overrides if _setting(name, _DATA)]
    without += [name for name in scenario.overrides if "evaluation.baseline" in name]
    if without:
        problems.append(
            f"{where}: with data and baselines of another scenario {without} do nothing"
        )


def _check_distinct(scenarios: Sequence[Scenario], problems: list[str]) -> None:
    for index, scenario in enumerate(scenarios):
        for other in scenarios[:index]:
            if sorted(scenario.overrides) == sorted(other.overrides):
                problems.append(
                    f"scenarios.{scenario.name} is the same as scenarios.{other.name}; keep one, "
                    "which may lie on several axes: at: {one_axis: 1, other_axis: 2}"
                )


def _overrides(
    listed: object, where: str, forbidden: Sequence[str], problems: list[str]
) -> tuple[str, ...]:
    if not isinstance(listed, list) or not all(isinstance(one, str) and one for one in listed):
        example = "a list of overrides such as [raters=minority]"
        problems.append(f"{where} must be {example}, got {listed!r}")
        return ()
    overrides = tuple(listed)
    for override in overrides:
        key = _setting(override, forbidden)
        if key:
            reason = (
                "is set by the benchmark itself"
                if key in _OURS
                else "would give methods different data or judges; put it into a scenario"
            )
            problems.append(f"{where}: {override!r} {reason}")
    return overrides


def _setting(override: str, settings: Sequence[str]) -> str | None:
    """The one of some settings, or groups of settings, that an override changes."""
    name = override.lstrip("+~").split("=", 1)[0].split("@", 1)[0].replace("/", ".")
    return next((key for key in settings if f"{name}.".startswith(f"{key}.")), None)


def _mapping(value: object, where: str, problems: list[str]) -> Mapping[Any, Any]:
    if isinstance(value, Mapping):
        return value
    problems.append(f"{where} must be a mapping, got {value!r}")
    return {}


def _named(
    content: Mapping[Any, Any], key: str, problems: list[str]
) -> Iterator[tuple[str, object]]:
    entries = _mapping(content.get(key), key, problems) if key in content else {}
    if not entries:
        problems.append(f"{key} must name at least one")
    for name, value in entries.items():
        if _NAME.fullmatch(str(name)):
            yield str(name), value
        else:
            problems.append(f"{key}: {name!r} does not do as a name; use letters, digits and _.-")


def _known(
    content: Mapping[Any, Any], where: str, keys: Sequence[str], problems: list[str]
) -> None:
    problems += [f"{where}: {_unknown('key', key, keys)}" for key in content if key not in keys]


def _unknown(what: str, name: object, known: Sequence[str]) -> str:
    nearest = difflib.get_close_matches(str(name), known, n=1)
    guess = f" Did you mean {nearest[0]!r}?" if nearest else ""
    return f"unknown {what} {name!r}.{guess} Known: {', '.join(known)}"
