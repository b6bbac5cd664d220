"""The one place in which what other people wrote is called.

Environments, raters, selection rules, methods and readers may be anybody's. Whatever they do, an
exception of any kind or ``sys.exit``, becomes one ``PlugInError`` that names the plug-in, what it
was doing, and the file and line; a plug-in that returns something wrong is named with the place at
which it is defined. Both are the user's to put right, and end a command with exit code 2.
"""

import inspect
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

__all__ = ["PlugInError", "call", "defined", "described", "failure", "is_foreign", "located"]

#: Where code of nobody's plug-in lies.
_LIBRARIES = tuple(
    str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "purelib", "platlib")
)


class PlugInError(ValueError):
    """What somebody else's code did, told so that they can put it right."""


def call(
    kind: str, name: str, doing: str, function: Callable[..., Any], *args: Any, **kwargs: Any
) -> Any:
    """Call what the author of a plug-in wrote.

    Args:
        kind: Kind of the plug-in, such as ``"env"``.
        name: What messages call it.
        doing: What is being done, such as ``"reset"``.
        function: What is called, with the arguments that follow.
        *args: Its arguments.
        **kwargs: Its keyword arguments.

    Raises:
        PlugInError: If it raises anything, or leaves the process with ``sys.exit``. Ctrl-C passes,
            and so do errors of plug-ins that the function calls.
    """
    try:
        return function(*args, **kwargs)
    except (KeyboardInterrupt, PlugInError):
        raise
    except BaseException as error:
        raise failure(kind, name, doing, error, function) from error


def failure(
    kind: str, name: str, doing: str, error: BaseException, function: Any = None
) -> PlugInError:
    """The error that tells what a plug-in raised, where.

    Args:
        kind: Kind of the plug-in.
        name: What messages call it.
        doing: What was being done.
        error: What it raised.
        function: What was called, for its place if the traceback shows none.
    """
    said = described(error)
    # Where nothing in the traceback is of somebody else, as with arguments that do not fit.
    place = "" if _raised(error.__traceback__) else defined(function)
    at = f" ({place})" if place else ""
    return PlugInError(f"{kind} {name!r}: {doing} failed with {said}{at}")


def described(error: BaseException) -> str:
    """What was raised, and the file and line of somebody else's code that raised it."""
    said = f"{type(error).__name__}: {error}"
    if isinstance(error, SystemExit):
        said = f"sys.exit({error.code!r}), which would end the run; raise an error instead"
    place = _raised(error.__traceback__)
    return f"{said} ({place})" if place else said


@contextmanager
def located(function: Any) -> Iterator[None]:
    """Add to errors about what a plug-in returned the place at which it is defined.

    Args:
        function: The plug-in.

    Raises:
        TypeError: The block's, with the place.
        ValueError: Likewise.
    """
    try:
        yield
    except PlugInError:
        raise
    except (TypeError, ValueError) as error:
        place = defined(function)
        raise type(error)(f"{error} ({place})" if place else str(error)) from error


def is_foreign(thing: Any) -> bool:
    """Whether a class, function or object comes from outside of this library."""
    module = getattr(thing, "__module__", None) or type(thing).__module__
    return module.partition(".")[0] != "popl_rl"


def defined(function: Any) -> str:
    """File and line at which a function or class is defined; empty if nobody knows."""
    inner = inspect.unwrap(function) if callable(function) else function
    inner = getattr(inner, "func", inner)  # of functools.partial
    if not (inspect.isroutine(inner) or inspect.isclass(inner)):
        inner = type(inner)
    try:
        line = inspect.getsourcelines(inner)[1]
        return f"{inspect.getsourcefile(inner)}, line {line}"
    except (OSError, TypeError):
        return ""


def _raised(trace: TracebackType | None) -> str:
    """File and line of the innermost frame that is of neither this library nor an installed one."""
    own = str(Path(__file__).parent)
    for frame in reversed(traceback.extract_tb(trace)):
        path = str(Path(frame.filename).resolve())
        if not path.startswith((*_LIBRARIES, own, "<")) and Path(path).is_file():
            return f"{frame.filename}, line {frame.lineno}"
    return ""
