"""Numbers of short runs, kept in golden/*.json: a change of results must be meant.

Rewrite them with ``pytest tests/test_golden.py --update-golden`` and look at the difference.
"""

import json
from pathlib import Path

import pytest
import torch

import popl_rl.algorithms.mixture_population
import popl_rl.algorithms.popl
from popl_rl.algorithms.mixture_population import MixturePOPL
from popl_rl.algorithms.popl import POPL
from popl_rl.algorithms.problem import Problem
from popl_rl.algorithms.variation import GaussianHead, GradientCPL
from popl_rl.config import MixtureSettings, Training
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.style_codes import train_clone

FOLDER = Path(__file__).parent / "golden"
SPEC = PolicySpec(5, 2, True, (8,))
MIXTURES = MixtureSettings(
    mixtures=4,
    generations=4,
    steps=3,
    bundle=5,
    first_selection=1,
    final_steps=50,
    folds=2,
)


@pytest.fixture
def selected(monkeypatch):
    """Parents of each generation, as lexicase selection reports them."""
    found = []

    def watch(module):
        original = module.lexicase_report

        def report(*arguments, **options):
            result = original(*arguments, **options)
            found.append(result.parents.tolist())
            return result

        monkeypatch.setattr(module, "lexicase_report", report)

    watch(popl_rl.algorithms.popl)
    watch(popl_rl.algorithms.mixture_population)
    return found


@pytest.fixture
def golden(request):
    """Compare with the file of a name, or rewrite it."""

    def check(name, found):
        path = FOLDER / f"{name}.json"
        if request.config.getoption("--update-golden"):
            path.write_text(json.dumps(found, indent=1) + "\n")
            pytest.skip(f"{path.name} rewritten")
        assert path.exists(), f"{path} is missing; make it with --update-golden"
        expected = json.loads(path.read_text())
        assert found.get("parents") == expected.get("parents")
        assert found["numbers"] == pytest.approx(expected["numbers"], rel=1e-5, abs=1e-7)

    return check


def numbers(popl, metrics):
    """The last generation's scalars, and what the members' tensors add up to."""
    sums = {
        "sum " + ".".join(name): float(value.abs().sum())
        for name, value in popl.population.members.data.items(True, True)
    }
    return {**metrics, **sums}


@pytest.mark.parametrize("variation", ["gradient", "gaussian"])
def test_popl(bank, comparisons, selected, golden, generator, variation):
    evolve = "head" if variation == "gaussian" else "all"
    recipe = Training(steps=6, batch_size=16)
    problem = Problem(SPEC, bank, comparisons, recipe, evolve=evolve, generations=3)
    population = problem.initial_population(6, generator=generator)
    if variation == "gaussian":
        varied = GaussianHead(population, generator=generator)
    else:
        varied = GradientCPL.of(problem, population, generator=generator)
    popl = POPL(problem, population=population, variation=varied, generator=generator)
    metrics = [popl.step() for _ in range(3)][-1]
    golden(f"popl_{variation}", {"parents": selected, "numbers": numbers(popl, metrics)})


def test_mixtures(bank, comparisons, selected, golden, generator):
    problem = Problem(SPEC, bank, comparisons, Training(batch_size=32))
    popl = MixturePOPL(problem, settings=MIXTURES, generator=generator)
    metrics = [popl.step() for _ in range(3)][-1]
    policies = popl.result()
    found = numbers(popl, metrics)
    found["members chosen"] = len(policies)
    found["sum chosen"] = total(policies.population)
    golden("mixtures", {"parents": selected, "numbers": found})


def total(population):
    """What all the members' tensors add up to."""
    values = population.members.data.values(True, True)
    return float(torch.cat([value.flatten() for value in values]).abs().sum())


#: The default method from its settings to the finished set: rater similarity, the last training
#: and the fitted scale included.
WHOLE = {
    "default": {},
    "style_codes": {"evolve": "code", "training__learning_rate": 0.05},
    "reward_functions": {"learns": "reward"},
}


@pytest.mark.parametrize("kind", WHOLE)
def test_the_default_method_as_a_whole(learner, bank, comparisons, golden, kind):
    generator = torch.Generator().manual_seed(0)
    spec = RewardSpec(5, 2, (8,)) if kind == "reward_functions" else SPEC
    clone = None
    if kind == "style_codes":
        clone = train_clone(spec, bank, steps=60, batch_size=16, generator=generator)
    popl = learner(
        spec,
        bank,
        comparisons,
        clone=clone,
        generator=generator,
        members=6,
        generations=3,
        training__steps=9,
        training__batch_size=16,
        popl__pooled_steps=10,
        popl__specialist_steps=5,
        refinement__steps=60,
        **WHOLE[kind],
    )
    found = {}
    for generation in range(3):
        found |= {f"{generation} {name}": value for name, value in popl.step().items()}
    found["sum of the population"] = total(popl.population)
    policies = popl.result()
    found |= {
        "policies": len(policies),
        "alpha": policies.alpha,
        "sum of the set": total(policies.population),
    }
    golden(f"whole_{kind}", {"numbers": found})
