"""A reference becomes an object: a name, ``package.module:attr``, or ``path/file.py:attr``.

Arguments may follow a rater's reference, so that one function stands for a family of groups:
``ring(1, 12)`` is the function registered as ``ring``, called with the segments, 1 and 12.

Nothing is known here by name. Objects are found because they were decorated (``env``, ``rater``,
``behaviour``) or because an installed package declares them as entry points in the group of their
kind, such as ``popl_rl.env``. References, not objects, are what configurations and worker
processes carry.
"""

import ast
import difflib
import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeVar, get_args

from popl_rl.plug_ins import described

__all__ = [
    "Kind",
    "behaviour",
    "env",
    "isolated",
    "method",
    "names",
    "rater",
    "reader",
    "resolve",
    "selection",
]

Kind = Literal["env", "rater", "behaviour", "features", "selection", "method", "reader"]
_T = TypeVar("_T", bound=Callable[..., Any])

_FORMS = (
    "A reference is a registered name, 'package.module:attr' or 'path/file.py:attr' "
    "(a relative path starts at the current directory)."
)
_registered: dict[str, dict[str, Any]] = {kind: {} for kind in get_args(Kind)}
#: What files declare, by kind, module and name: ``file.py:name`` finds it, whoever has it else.
_declared: dict[tuple[str, str, str], Any] = {}
_FILE = "popl_rl_file_"  # before the names of modules that are loaded from files
_folders: set[str] = set()  # of files that were loaded, from which these import what is beside them


def env(name: str) -> Callable[[_T], _T]:
    """Register a factory of Gymnasium environments: keyword arguments -> ``gymnasium.Env``.

    Args:
        name: What configurations call it.

    Raises:
        ValueError: When decorating, if another object has the name.
    """
    return _decorator("env", name)


def rater(name: str) -> Callable[[_T], _T]:
    """Register a rater group: segments ``[B, T]`` -> utility of each step ``[B, T]``.

    Args:
        name: What configurations call it.

    Raises:
        ValueError: When decorating, if another object has the name.

    Example:
        >>> from popl_rl.registry import rater, resolve
        >>> @rater("tender")
        ... def tender(segments):
        ...     return -segments["action"].square().sum(-1)
        >>> resolve("rater", "tender") is tender
        True
    """
    return _decorator("rater", name)


def behaviour(name: str) -> Callable[[_T], _T]:
    """Register a policy that gathers data.

    Args:
        name: What configurations call it.

    Raises:
        ValueError: When decorating, if another object has the name.
    """
    return _decorator("behaviour", name)


def selection(name: str) -> Callable[[_T], _T]:
    """Register a rule of selection: ``(values [member, case], count, *, generator) -> parents``.

    Args:
        name: What configurations call it.

    Raises:
        ValueError: When decorating, if another object has the name.
    """
    return _decorator("selection", name)


def method(name: str) -> Callable[[_T], _T]:
    """Register a method: a class that is built from a ``Problem`` and has steps and a result.

    See ``popl_rl.algorithms.problem.Method``.

    Args:
        name: What configurations call it.

    Raises:
        ValueError: When decorating, if another object has the name.
    """
    return _decorator("method", name)


def reader(name: str) -> Callable[[_T], _T]:
    """Register a reader of other people's data: path -> segments and preferences.

    Args:
        name: What configurations call it.

    Raises:
        ValueError: When decorating, if another object has the name.
    """
    return _decorator("reader", name)


def names(kind: Kind) -> list[str]:
    """List the names known for a kind, sorted: decorated so far or from installed packages."""
    _check_kind(kind)
    return sorted({*_registered[kind], *_entry_points(kind)})


def resolve(kind: Kind, reference: str) -> Any:
    """Return the object that a reference names.

    A file is loaded once per process. Loading it also registers what it decorates, and lets it
    import the files beside it. ``file.py:name`` is what the file calls so, or decorates so.

    Args:
        kind: What is expected, such as "env" or "rater".
        reference: A registered name, ``package.module:attr`` or ``path/file.py:attr``.

    Raises:
        ValueError: If the name, module, file or attribute does not exist, or importing it fails;
            the message says what there is.
        TypeError: If the reference is no string or what it names cannot be called.
    """
    _check_kind(kind)
    if not isinstance(reference, str):
        raise TypeError(
            f"{kind} reference must be a string, got {type(reference).__name__}. {_FORMS}"
        )
    if kind == "rater" and reference.endswith(")"):
        called, arguments = _arguments(reference)
        found = resolve(kind, called)
        return lambda segments: found(segments, *arguments)
    source, colon, attribute = reference.rpartition(":")
    if not colon:
        found = _by_name(kind, reference)
    elif not source or not attribute:
        raise ValueError(f"{kind} {reference!r} is incomplete. {_FORMS}")
    else:
        module = _load_file(kind, reference, source) if _is_path(source) else None
        module = module or _import(kind, reference, source)
        found = _attribute(kind, reference, module, attribute)
    if not callable(found):
        raise TypeError(
            f"{kind} {reference!r} must name a function or class, got a {type(found).__name__}."
        )
    return found


def _arguments(reference: str) -> tuple[str, tuple[Any, ...]]:
    """Split ``name(1, 12)`` into the reference and its arguments."""
    called, _, listed = reference[:-1].partition("(")
    try:
        arguments = ast.literal_eval(f"({listed},)") if listed.strip() else ()
    except (SyntaxError, ValueError) as error:
        raise ValueError(
            f"rater {reference!r} has arguments that cannot be read; write numbers or quoted "
            "words, as in ring(1, 12)."
        ) from error
    return called, arguments


def _check_kind(kind: str) -> None:
    if kind not in _registered:
        raise ValueError(f"kind must be one of {sorted(_registered)}, got {kind!r}.")


def _decorator(kind: Kind, name: str) -> Callable[[_T], _T]:
    if not isinstance(name, str) or not name or ":" in name:
        raise ValueError(
            f"@{kind} needs a name without ':', as in @{kind}('my_{kind}'), got {name!r}."
        )

    def register(found: _T) -> _T:
        module = getattr(found, "__module__", "")
        is_from_file = module.startswith(_FILE)
        if is_from_file:
            _declared[kind, module, name] = found
        held = _holder(kind, name)
        if held is not None and is_from_file and name in _entry_points(kind):
            # A name of another world's, which somebody with a file need not know; file.py:name is
            # theirs all the same.
            return found
        # A reload, or the same file loaded a second way, defines the same thing again.
        if held is not None and held != _origin(found):
            raise ValueError(
                f"{kind} name {name!r} is taken by {held[1]} in {held[0]}; choose another name."
            )
        _registered[kind][name] = found
        return found

    return register


def _origin(found: Any) -> tuple[str, str]:
    """Return the file and qualified name an object was defined in."""
    module = getattr(found, "__module__", "")
    file = getattr(sys.modules.get(module), "__file__", None)
    where = str(Path(file).resolve()) if file else module
    return where, getattr(found, "__qualname__", type(found).__qualname__)


def _holder(kind: Kind, name: str) -> tuple[str, str] | None:
    if name in _registered[kind]:
        return _origin(_registered[kind][name])
    point = _entry_points(kind).get(name)
    if point is None:
        return None
    try:
        spec = importlib.util.find_spec(point.module)
    except ImportError:
        spec = None
    where = str(Path(spec.origin).resolve()) if spec and spec.origin else point.module
    return where, point.attr


@cache
def _entry_points(kind: Kind) -> dict[str, EntryPoint]:
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=f"popl_rl.{kind}"):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            raise ValueError(
                f"{kind} name {point.name!r} is declared by two installed packages, as "
                f"{other.value} and {point.value}; uninstall one of them."
            )
    return found


def _by_name(kind: Kind, name: str) -> Any:
    if name in _registered[kind]:
        return _registered[kind][name]
    point = _entry_points(kind).get(name)
    if point is not None:
        module = _import(kind, name, point.module)
        return _attribute(kind, name, module, point.attr)
    if name.endswith(".py"):
        raise ValueError(
            f"{kind} {name!r} names a file: add ':' and what to take from it. {_FORMS}"
        )
    known = names(kind)
    nearest = difflib.get_close_matches(name, known, n=1)
    guess = f" Did you mean {nearest[0]!r}?" if nearest else ""
    listed = ", ".join(known) or "none"
    raise ValueError(f"unknown {kind} {name!r}.{guess} Known: {listed}. {_FORMS}")


def _is_path(source: str) -> bool:
    return source.endswith(".py") or "/" in source or "\\" in source


def _import(kind: Kind, reference: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        missing = isinstance(error, ModuleNotFoundError) and name.startswith(str(error.name))
        meant = f" Is it installed, or did you mean the file '{name.replace('.', '/')}.py:...'?"
        cure = meant if missing else ""
        raise ValueError(
            f"{kind} {reference!r}: importing module {name!r} failed with "
            f"{described(error)}.{cure} {_FORMS}"
        ) from error


def _load_file(kind: Kind, reference: str, source: str) -> ModuleType:
    path = Path(source).expanduser().resolve()
    if not path.is_file() or path.suffix != ".py":
        near = sorted(str(other.name) for other in path.parent.glob("*.py"))
        listed = ", ".join(near) or "none"
        raise ValueError(
            f"{kind} {reference!r}: there is no Python file {path}. Python files in that folder: "
            f"{listed}. {_FORMS}"
        )
    # The digest keeps two files of one name apart; being in sys.modules lets pickle find what the
    # file defines.
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:12]
    name = f"{_FILE}{path.stem}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    _import_beside(kind, reference, path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        del sys.modules[name]
        raise ValueError(
            f"{kind} {reference!r}: running {path} failed with {described(error)}"
        ) from error
    return module


def _import_beside(kind: Kind, reference: str, path: Path) -> None:
    """Let a file import those beside it, as if it were run as a script.

    Raises:
        ValueError: If it would get a module of the same name from beside another such file.
    """
    folder = str(path.parent)
    for other in path.parent.glob("*.py"):
        loaded = getattr(sys.modules.get(other.stem), "__file__", None)
        if loaded is None or str(Path(loaded).parent) not in _folders - {folder}:
            continue
        if re.search(rf"^\s*(import|from)\s+{re.escape(other.stem)}\b", path.read_text(), re.M):
            raise ValueError(
                f"{kind} {reference!r}: {path} imports {other.stem!r}, which in this process is "
                f"{loaded} already, beside another file; rename one of the two"
            )
    _folders.add(folder)
    if folder not in sys.path:
        sys.path.append(folder)  # the last, so that nothing installed is hidden


def _attribute(kind: Kind, reference: str, module: ModuleType, name: str) -> Any:
    if (kind, module.__name__, name) in _declared:
        return _declared[kind, module.__name__, name]
    if hasattr(module, name):
        return getattr(module, name)
    own = sorted(
        {
            key
            for key, value in vars(module).items()
            if not key.startswith("_")
            and callable(value)
            and getattr(value, "__module__", None) == module.__name__
        }
        | {
            declared
            for of, source, declared in _declared
            if (of, source) == (kind, module.__name__)
        }
    )
    nearest = difflib.get_close_matches(name, own, n=1)
    guess = f" Did you mean {nearest[0]!r}?" if nearest else ""
    raise ValueError(
        f"{kind} {reference!r}: {module.__file__} has no {name!r}.{guess} It defines: "
        f"{', '.join(own) or 'nothing'}."
    )


@contextmanager
def isolated() -> Iterator[None]:
    """Start with nothing decorated and forget afterwards what was: for tests of plug-ins.

    Names that installed packages declare stay known, as in a new process.
    """
    kept = {kind: dict(found) for kind, found in _registered.items()}
    for found in _registered.values():
        found.clear()
    _entry_points.cache_clear()
    try:
        yield
    finally:
        for kind, found in kept.items():
            _registered[kind].clear()
            _registered[kind].update(found)
        _entry_points.cache_clear()
