"""Which package may import which, and what every module looks like."""

import ast
import importlib
import inspect
from functools import cache
from pathlib import Path

import pytest

import popl_rl
import popl_rl.config

PACKAGE = Path(popl_rl.__file__).parent
ROOT = PACKAGE.parent
FOLDERS = {
    "popl_rl": PACKAGE,
    "popl_rl.envs": ROOT / "envs",
    "popl_rl.trainers": ROOT / "trainers",
    "popl_rl.configs": ROOT / "configs",
}
#: What each package may import besides itself. A module directly in popl_rl is of ``root``;
#: ``testing`` is what people check their own environments, raters and methods with. Settings stop
#: at ``experiments``; but a method is built from the sections of settings that it reads.
ALLOWED = {
    "root": set(),
    "config": set(),
    "selection": set(),
    "data": {"root"},
    "raters": {"root", "data"},
    "models": {"root", "selection", "data"},
    "algorithms": {"root", "config", "selection", "data", "models"},
    "evaluation": {"root", "selection", "data", "raters", "models", "algorithms"},
    "plotting": {"root", "data", "raters", "models", "algorithms", "evaluation"},
    "experiments": {
        "root",
        "config",
        "selection",
        "data",
        "raters",
        "models",
        "algorithms",
        "evaluation",
        "plotting",
    },
    "envs": {"root", "data", "raters"},
    "configs": set(),
}
ALLOWED["web"] = {*ALLOWED["plotting"], "plotting", "selection"}
ALLOWED["testing"] = {"root", "config", "selection", "data", "raters", "models", "algorithms"}
ALLOWED["trainers"] = {*ALLOWED["experiments"], "experiments", "web", "configs"}


def _modules():
    found = {}
    for name, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join([name, *parts])] = path
    return found


MODULES = _modules()
LIBRARY = sorted(name for name, path in MODULES.items() if path.is_relative_to(PACKAGE))
PACKAGES = sorted(name for name in LIBRARY if MODULES[name].name == "__init__.py")
TREES = {module: ast.parse(path.read_text()) for module, path in MODULES.items()}
TESTS = sorted((ROOT / "tests").rglob("*.py"))


def package_of(module):
    """The package of ``ALLOWED`` that a module belongs to."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in ALLOWED else "root"


@cache
def imports(module):
    """Modules of the project that a module imports, wherever in its source."""
    found = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found.update(name for name in names if name in MODULES)
            if not names <= MODULES.keys():
                found.add(node.module)
    return frozenset(name for name in found if name in MODULES)


def reachable(module):
    """Modules of the project that are imported by a module, by what it imports, and so on."""
    seen, ahead = set(), [module]
    while ahead:
        for name in imports(ahead.pop()) - seen:
            seen.add(name)
            ahead.append(name)
    return seen


@pytest.mark.parametrize("module", sorted(set(MODULES) - {"popl_rl"}))
def test_packages_import_one_way(module):
    own = package_of(module)
    foreign = {name: package_of(name) for name in imports(module)}
    wrong = {n: p for n, p in foreign.items() if p != own and p not in ALLOWED[own]}
    assert wrong == {}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_there_are_no_circles(module):
    assert module not in reachable(module)


def test_a_learner_cannot_reach_who_voted():
    for module in MODULES:
        if package_of(module) in ("selection", "data", "models", "algorithms"):
            assert {package_of(name) for name in reachable(module)}.isdisjoint(
                {"raters", "evaluation", "experiments"}
            ), module


def test_algorithms_read_sections_of_the_method_alone():
    sections = {"popl_rl.config.method", "popl_rl.config.checks"}
    for module in MODULES:
        if package_of(module) != "algorithms":
            continue
        for node in ast.walk(TREES[module]):
            if isinstance(node, ast.ImportFrom) and node.module == "popl_rl.config":
                names = [getattr(popl_rl.config, alias.name) for alias in node.names]
                assert {value.__module__ for value in names} <= sections, module


LEARNERS = [m for m in LIBRARY if package_of(m) in ("selection", "models", "algorithms")]


@pytest.mark.parametrize("module", [*LEARNERS, "popl_rl.data.comparisons", "popl_rl.data.bank"])
def test_what_learns_names_no_hidden_key(module):
    names = {node.id for node in ast.walk(TREES[module]) if isinstance(node, ast.Name)}
    assert names.isdisjoint({"HIDDEN", "GROUP", "UTILITY", "HIDDEN_KEYS"})
    assert '"hidden"' not in MODULES[module].read_text()


@pytest.mark.parametrize("path", [*MODULES.values(), *TESTS], ids=str)
def test_no_module_uses_the_private_names_of_another(path):
    tree = ast.parse(path.read_text())
    ours = set()  # names under which modules of the project were imported
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("popl_rl"):
            private = [a.name for a in node.names if a.name.startswith("_")]
            assert private == [], f"{node.module}: {private}"
            ours.update(
                alias.asname or alias.name
                for alias in node.names
                if f"{node.module}.{alias.name}" in MODULES
            )
        elif isinstance(node, ast.Import):
            ours.update(a.asname for a in node.names if a.asname and a.name in MODULES)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            if node.attr.startswith("__"):
                continue
            dotted = ast.unparse(node.value)
            assert dotted not in ours, f"{dotted}.{node.attr}"
            assert not dotted.startswith("popl_rl."), f"{dotted}.{node.attr}"


@pytest.mark.parametrize("module", LIBRARY)
def test_the_library_prints_nothing(module):
    calls = [node for node in ast.walk(TREES[module]) if isinstance(node, ast.Call)]
    assert not [call for call in calls if getattr(call.func, "id", None) == "print"]


def test_files_are_short():
    paths = [*MODULES.values(), *TESTS]
    assert len(paths) > 150
    lengths = {path.relative_to(ROOT): len(path.read_text().splitlines()) for path in paths}
    assert {str(path): length for path, length in lengths.items() if length > 400} == {}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_functions_are_short(module):
    long = {}
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0]
            has_docstring = ast.get_docstring(node) is not None
            docstring = first.end_lineno - first.lineno + 1 if has_docstring else 0
            lines = node.end_lineno - node.lineno + 1 - docstring
            if lines > 60:
                long[node.name] = lines
    assert long == {}


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


@pytest.mark.parametrize("package", [name for name in PACKAGES if name != "popl_rl"])
def test_a_package_says_what_is_inside(package):
    """In a few lines, and with the name of every one of its modules."""
    said = importlib.import_module(package).__doc__
    inside = [m for m in MODULES if m.rpartition(".")[0] == package]
    own = [m for m in inside if not m.split(".")[-1].startswith("_")]
    assert [m for m in own if f"``{m.rpartition('.')[2]}``" not in said] == []


@pytest.mark.parametrize("module", [m for m in LIBRARY if "._" not in m])
def test_every_module_says_what_is_public(module):
    # keys.py is one table, all of it public; a package's modules are its contents.
    alone = module == "popl_rl.keys" or (module in PACKAGES and module != "popl_rl")
    assert alone or importlib.import_module(module).__all__
