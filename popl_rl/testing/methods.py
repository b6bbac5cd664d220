"""The check of a method."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from inspect import signature
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch
from torch import Tensor

from popl_rl import registry
from popl_rl.algorithms.problem import Method, Problem
from popl_rl.algorithms.trainer import MethodTrainer
from popl_rl.config import (
    EMSettings,
    KMeansSettings,
    LoReSettings,
    MixtureSettings,
    NicheSettings,
    POPLSettings,
    RefinementSettings,
    VPLSettings,
)
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.population import Population
from popl_rl.models.sets import load_set
from popl_rl.plug_ins import call
from popl_rl.testing.plug_ins import name_of
from popl_rl.testing.tiny_problem import poisoned, tiny_data, tiny_problem

__all__ = ["check_method"]

#: Sections of settings for a factory that names them among its arguments: as small as they can be.
_SECTIONS: dict[str, Any] = {
    "popl": POPLSettings(specialist_steps=3, pooled_steps=4, warm_up=3),
    "refinement": RefinementSettings(steps=20),
    "niches": NicheSettings(specialists=6),
    "mixture": MixtureSettings(
        mixtures=3, generations=3, steps=2, first_selection=1, final_steps=4
    ),
    "em": EMSettings(groups=2),
    "vpl": VPLSettings(),
    "lore": LoReSettings(bases=3),
    "kmeans": KMeansSettings(groups=2),
}


def check_method(
    method: str | Callable[..., Method],
    *,
    cases: Literal["rater", "preference"] = "rater",
    evolve: Literal["all", "head"] = "all",
    learns: Literal["policy", "reward"] = "policy",
    sections: Mapping[str, Any] | None = None,
    seed: int = 0,
    **options: Any,
) -> None:
    """Check that a method keeps what runs rely on; the first fault found is raised.

    It learns for a few generations from the answers of two groups about ``tiny_env``: twice from
    one seed, once interrupted and resumed as ``popl-train resume=`` does, and once from data whose
    hidden keys are garbage.

    Args:
        method: A class with the protocol of ``popl_rl.algorithms.problem.Method``, a function that
            makes one, or a reference to either.
        cases: What lexicase filters on.
        evolve: Whole networks, or last layers on a shared trunk.
        learns: Policies or reward functions.
        sections: Sections of settings by name, such as ``{"vpl": VPLSettings()}``; small ones for
            the arguments of the method that are called as sections are if None.
        seed: Seed of data and learning.
        **options: Further arguments of the method, as ``method.options`` are.

    Raises:
        TypeError: If the method lacks an attribute of the protocol, or steps and results are of
            another kind than expected.
        ValueError: If the method fails; a generation reports no ``worst_rater_accuracy``, other
            scalars than the first one, or numbers that are not finite; ``generation`` does not
            count; no parameter moves; another run from the same seed, or after resuming, differs in
            a bit; it draws from torch's global generator, changes the problem or reads what is
            hidden; or its result cannot be saved and loaded, or chooses nobody for a rater.

    Example:
        >>> from popl_rl.testing import check_method
        >>> check_method("popl_rl.algorithms.multi_cpl:MultiCPL")
    """
    name = name_of(method)
    factory = registry.resolve("method", method) if isinstance(method, str) else method
    given = _sections_of(factory) if sections is None else sections
    segments, preferences = tiny_data(seed)

    def problem_of(data: tuple[Any, Any]) -> Problem:
        return tiny_problem(*data, cases=cases, evolve=evolve, learns=learns)

    def build(problem: Problem) -> Method:
        generator = torch.Generator().manual_seed(seed)
        arguments = {"generator": generator, **given, **options}
        made: Method = call("method", name, "building it", factory, problem, **arguments)
        return made

    problem, untouched = problem_of((segments, preferences)), problem_of((segments, preferences))
    state = torch.random.get_rng_state()
    first = build(problem)
    _check_protocol(name, first)
    before = _members(first)
    said = [_checked_step(name, first, done) for done in range(first.generations)]
    _check_scalars(name, said)
    found = _bits(name, first)
    _check_result(name, found[0], problem, preferences)
    if not torch.equal(state, torch.random.get_rng_state()):
        raise ValueError(
            f"method {name!r} must draw from the generator that it is given, but drew from torch's "
            "global one; pass generator=generator, or build networks with "
            "popl_rl.models.policies.build_network."
        )
    _check_untouched(name, problem, untouched)
    if all(map(torch.equal, before, _members(first))):
        raise ValueError(
            f"method {name!r} must learn, but after {first.generations} generations every parameter"
            " of its population is what it was; change population.members.data in step()."
        )
    expected = said, found
    _compare(name, expected, _run(name, build(problem)), "a second run from the same seed")
    resumed = _resumed(name, build(problem), build(problem))
    _compare(name, (said[1:], found), resumed, "a run that was interrupted after a generation")
    for how in ("garbage", "absent"):
        hidden = poisoned(segments, preferences, how=how)  # type: ignore[arg-type]
        again = _run(name, build(problem_of(hidden)))
        _compare(name, expected, again, f"a run whose hidden keys are {how}")


def _sections_of(factory: Callable[..., Method]) -> dict[str, Any]:
    return {name: _SECTIONS[name] for name in signature(factory).parameters if name in _SECTIONS}


def _check_protocol(name: str, method: Any) -> None:
    """Check that a method has what the protocol says."""
    for attribute in ("step", "result", "state_dict", "load_state_dict"):
        if not callable(getattr(method, attribute, None)):
            raise TypeError(
                f"method {name!r} must have a method {attribute}(), but a "
                f"{type(method).__name__} has none; see popl_rl.algorithms.problem.Method."
            )
    for attribute, least in (("generation", 0), ("generations", 1)):
        value = getattr(method, attribute, None)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise TypeError(
                f"method {name!r} must have {attribute}, an int of at least {least}, got {value!r};"
                " set it in __init__, generations to problem.generations."
            )
    if method.generation != 0:
        raise ValueError(f"method {name!r} must begin with generation 0, got {method.generation}.")
    if not isinstance(getattr(method, "population", None), Population):
        raise TypeError(
            f"method {name!r} must have population, a popl_rl.models.population.Population, got a "
            f"{type(getattr(method, 'population', None)).__name__}; make one with "
            "problem.initial_population(problem.members, generator=generator)."
        )


def _checked_step(name: str, method: Method, done: int) -> dict[str, float]:
    """Run a generation and check what it says."""
    said = call("method", name, f"generation {done + 1}", method.step)
    if not isinstance(said, dict) or not all(isinstance(key, str) for key in said):
        raise TypeError(
            f"method {name!r}: step() must return a dict of scalars by name, got a "
            f"{type(said).__name__}."
        )
    if method.generation != done + 1:
        raise ValueError(
            f"method {name!r}: step() must raise generation by 1, got {method.generation} after "
            f"{done + 1} generations; add self.generation += 1."
        )
    for key, value in said.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise TypeError(
                f"method {name!r}: step() must return numbers, got a {type(value).__name__} for "
                f"{key!r}; use float()."
            )
        if not math.isfinite(value):
            raise ValueError(
                f"method {name!r}: step() must return finite numbers, got {value} for {key!r} in "
                f"generation {done + 1}."
            )
    return said


def _check_scalars(name: str, said: list[dict[str, float]]) -> None:
    """Check which scalars the generations report."""
    worst = said[0].get("worst_rater_accuracy", math.nan)
    if not 0 <= worst <= 1:
        raise ValueError(
            f"method {name!r}: step() must return worst_rater_accuracy, in [0, 1], got "
            f"{said[0].get('worst_rater_accuracy')} among {sorted(said[0])}; see "
            "popl_rl.models.scoring.rater_accuracy."
        )
    for generation, later in enumerate(said[1:], 2):
        if later.keys() != said[0].keys():
            raise ValueError(
                f"method {name!r}: step() must return the same scalars each time, got "
                f"{sorted(said[0])} and in generation {generation} {sorted(later)}."
            )


def _check_result(name: str, found: Any, problem: Problem, preferences: Any) -> None:
    """Check that a result is a set that can be kept and chosen from."""
    if not isinstance(found, HypothesisSet) or not len(found):
        raise TypeError(
            f"method {name!r}: result() must return a set of at least one hypothesis, got a "
            f"{type(found).__name__}; use problem.hypothesis_set(population)."
        )
    values = [value for _, value in _leaves(found)]
    if not all(bool(value.isfinite().all()) for value in values) or not 0 < found.alpha < math.inf:
        raise ValueError(
            f"method {name!r}: result() must hold finite parameters and a positive alpha, got "
            f"{sum(int((~value.isfinite()).sum()) for value in values)} that are not finite and "
            f"alpha {found.alpha}."
        )
    answers = preferences[:5]
    member = call("method", name, "catering", found.cater, problem.bank, answers).member
    if not 0 <= member < len(found):
        raise ValueError(
            f"method {name!r}: result().cater() must choose a member, 0..{len(found) - 1}, got "
            f"{member}."
        )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "found"
        call("method", name, "saving the result", found.save, path)
        loaded = call("method", name, "loading the result", load_set, path)
    kept = dict(_leaves(loaded))
    if len(loaded) != len(found) or not all(
        torch.equal(kept[key], value) for key, value in _leaves(found)
    ):
        raise ValueError(f"method {name!r}: result() must be the same after save() and load_set().")


def _check_untouched(name: str, problem: Problem, untouched: Problem) -> None:
    """Check that what all methods are given is as it was."""
    for part in ("bank", "comparisons"):
        ours, theirs = getattr(untouched, part), getattr(problem, part)
        for field in fields(ours):
            one, other = getattr(ours, field.name), getattr(theirs, field.name)
            if isinstance(one, Tensor) and not torch.equal(one, other):
                raise ValueError(
                    f"method {name!r} must leave the problem as it is, which the oracle and pooled "
                    f"CPL are given too, but changed problem.{part}.{field.name}; work on a copy."
                )


_Run = tuple[list[dict[str, float]], tuple[HypothesisSet, list[Tensor]]]


def _run(name: str, method: Method) -> _Run:
    """Do all generations and give what they said and what was found."""
    said = [
        call("method", name, f"generation {done + 1}", method.step)
        for done in range(method.generations)
    ]
    return said, _bits(name, method)


def _resumed(name: str, interrupted: Method, resumed: Method) -> _Run:
    """Stop after a generation, and continue in another object from the checkpoint."""
    said: list[dict[str, float]] = []

    def train(method: Method, generations: int) -> None:
        trainer = MethodTrainer(
            method,
            generations=generations,
            checkpoint_dir=Path(folder),
            checkpoint_interval=1,
            on_generation=lambda _, values: said.append(values),
        )
        trainer.resume()
        trainer.train()

    with TemporaryDirectory() as folder:
        call("method", name, "writing its state_dict()", train, interrupted, 1)
        said.clear()
        doing = "resuming from its state_dict()"
        call("method", name, doing, train, resumed, resumed.generations)
    return said, _bits(name, resumed)


def _bits(name: str, method: Method) -> tuple[HypothesisSet, list[Tensor]]:
    """The result, and every tensor that decides what it does."""
    found = call("method", name, "result()", method.result)
    members = _members(method)
    if isinstance(found, HypothesisSet):
        members += [torch.tensor(found.alpha), *(value for _, value in _leaves(found))]
    return found, members


def _members(method: Method) -> list[Tensor]:
    population = method.population.plain()
    return [value.detach().clone() for value in population.members.data.values(True, True)]


def _leaves(found: HypothesisSet) -> list[tuple[str, Tensor]]:
    members = found.population.plain().members.data
    return [(str(key), members[key].clone()) for key in members.keys(True, True)]


def _compare(name: str, expected: _Run, again: _Run, what: str) -> None:
    """Raise unless two runs are equal to the bit."""
    (said, (_, bits)), (said_again, (_, bits_again)) = expected, again
    cure = "take all randomness from the generator, and keep no state outside of the object"
    if "interrupted" in what:
        cure = "state_dict() must hold everything that the next generation depends on"
    if "hidden" in what:
        cure = "a method may read the problem alone"
    for generation, (one, other) in enumerate(zip(said, said_again, strict=True), 1):
        for key in one:
            if one[key] != other.get(key):
                raise ValueError(
                    f"method {name!r}: {what} must be equal to the bit, but {key} differs, "
                    f"{one[key]} and {other.get(key)}, in its generation {generation}; {cure}."
                )
    if len(bits) != len(bits_again) or not all(map(torch.equal, bits, bits_again)):
        raise ValueError(
            f"method {name!r}: {what} must be equal to the bit, but the hypotheses differ; {cure}."
        )
