"""Which module may import which, and what every module looks like."""

import ast
import importlib
import inspect
from functools import cache
from pathlib import Path

import pytest

import popl_rl

PACKAGE = Path(popl_rl.__file__).parent
ROOT = PACKAGE.parent
FOLDERS = {
    "popl_rl": PACKAGE,
    "popl_rl.envs": ROOT / "envs",
    "popl_rl.trainers": ROOT / "trainers",
    "popl_rl.configs": ROOT / "configs",
}
MODULES = {
    f"{name}.{path.stem}": path
    for name, folder in FOLDERS.items()
    for path in sorted(folder.glob("*.py"))
    if path.stem != "__init__"
}
LIBRARY = sorted(name for name, path in MODULES.items() if path.parent == PACKAGE)
LEARNERS = [
    f"popl_rl.{name}"
    for name in (
        "answers",
        "brex",
        "calibration",
        "comparisons",
        "dpl",
        "downsampling",
        "em",
        "kinship",
        "lexicase",
        "losses",
        "multi_cpl",
        "policies",
        "polish",
        "popl",
        "population",
        "rewards",
        "selection",
        "styled_population",
        "styles",
        "teams",
        "variation",
        "vpl",
    )
]
#: A module of one layer imports modules of earlier layers, or of its own.
LAYERS = (
    {
        "keys",
        "registry",
        "config",
        "lexicase",
        "_pools",
        "downsampling",
        "planning",
        "majority",
        "method_names",
        "selection",
    },
    {"raters", "rollouts", "segments", "policies", "rewards", "comparisons"},
    {
        "answers",
        "preferences",
        "losses",
        "polish",
        "population",
        "styled_population",
        "styles",
        "values",
        "variation",
    },
    {
        "popl",
        "policy_set",
        "teams",
        "evaluation",
        "baselines",
        "brex",
        "calibration",
        "dpl",
        "em",
        "kinship",
        "multi_cpl",
        "ppo",
        "reward_baselines",
        "_env_checks",
        "testing",
        "vpl",
    },
    {
        "acting",
        "alternatives",
        "animation",
        "benchmark",
        "benchmark_curves",
        "benchmark_plots",
        "benchmark_report",
        "data",
        "jobs",
        "likeness",
        "reward_pictures",
        "suite",
        "utility_plots",
        "experiment",
        "findings",
        "founding",
        "hindsight",
        "panel",
        "results",
        "loggers",
        "motion_pictures",
        "motion_plots",
        "plot_style",
        "plots",
        "report",
        "pictures",
        "runs",
        "scoreboard",
        "store",
        "trainer",
        "worlds",
    },
)


@cache
def imports(module):
    """Modules of the package that a module imports, wherever in its source."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(name for name in found if name in MODULES)


def reachable(module):
    """Modules of the package that are imported by a module, by what it imports, and so on."""
    seen, ahead = set(), [module]
    while ahead:
        for name in imports(ahead.pop()) - seen:
            seen.add(name)
            ahead.append(name)
    return seen


def layer_of(module):
    (layer,) = [i for i, names in enumerate(LAYERS) if module.removeprefix("popl_rl.") in names]
    return layer


def test_the_layers_name_every_module_of_the_library_once():
    named = [f"popl_rl.{name}" for layer in LAYERS for name in layer]
    assert sorted(named) == LIBRARY


@pytest.mark.parametrize("module", LIBRARY)
def test_the_library_knows_no_environment_and_no_script(module):
    source = MODULES[module].read_text()
    outside = [name for name in imports(module) if MODULES[name].parent != PACKAGE]
    assert outside == []
    for folder in ("envs", "trainers"):
        assert f"import popl_rl.{folder}" not in source
        assert f"from popl_rl.{folder}" not in source
        assert f"from popl_rl import {folder}" not in source


@pytest.mark.parametrize("module", LIBRARY)
def test_imports_go_down_the_layers(module):
    up = [name for name in imports(module) if layer_of(name) > layer_of(module)]
    assert up == []


@pytest.mark.parametrize("module", LIBRARY)
def test_there_are_no_circles(module):
    assert module not in reachable(module)


@pytest.mark.parametrize("module", LEARNERS)
def test_what_learns_cannot_see_who_voted(module):
    forbidden = {"popl_rl.raters", "popl_rl.preferences", "popl_rl.evaluation"}
    assert imports(module).isdisjoint(forbidden)
    source = MODULES[module].read_text()
    for name in ("HIDDEN", "GROUP", "UTILITY"):
        assert name not in [node.id for node in ast.walk(ast.parse(source)) if hasattr(node, "id")]
    assert '"hidden"' not in source


@pytest.mark.parametrize("module", ["losses", "popl", "variation", "population", "comparisons"])
def test_not_even_by_way_of_another_module(module):
    assert reachable(f"popl_rl.{module}").isdisjoint({"popl_rl.raters", "popl_rl.preferences"})


@pytest.mark.parametrize("module", [name for name in LIBRARY if name != "popl_rl.testing"])
def test_the_library_prints_nothing(module):
    calls = [
        node
        for node in ast.walk(ast.parse(MODULES[module].read_text()))
        if isinstance(node, ast.Call)
    ]
    assert not [call for call in calls if getattr(call.func, "id", None) == "print"]


def test_files_are_short():
    paths = [path for name in (*FOLDERS.values(), ROOT / "tests") for path in name.rglob("*.py")]
    assert len(paths) > 40
    lengths = {path.relative_to(ROOT): len(path.read_text().splitlines()) for path in paths}
    assert {path: length for path, length in lengths.items() if length > 500} == {}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_public_names_exist_and_are_documented(module):
    found = importlib.import_module(module)
    assert found.__doc__
    for name in getattr(found, "__all__", []):
        value = getattr(found, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            own = value.__doc__ or ""
            # A dataclass without a docstring is given its signature.
            assert own, f"{module}.{name} has no docstring"
            assert not own.startswith(f"{name}("), f"{module}.{name} has no docstring of its own"
        else:
            assert name in MODULES[module].read_text()


def test_names_of_the_package_are_loaded_when_used():
    assert sorted(popl_rl.__all__) == popl_rl.__all__
    for name in popl_rl.__all__:
        assert getattr(popl_rl, name).__doc__
        assert name in dir(popl_rl)
    with pytest.raises(AttributeError, match="module 'popl_rl' has no attribute 'nonsense'"):
        popl_rl.nonsense  # noqa: B018


@pytest.mark.parametrize("module", [name for name in LIBRARY if "._" not in name])
def test_every_module_says_what_is_public(module):
    # keys.py is one table, all of it public.
    assert module == "popl_rl.keys" or importlib.import_module(module).__all__
