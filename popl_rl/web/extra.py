"""Whether what the pages need is installed; imports none of it."""

from importlib.util import find_spec

__all__ = ["require_extra"]


def require_extra() -> None:
    """Raise unless what the pages need is installed.

    Raises:
        ValueError: With the command that installs it.
    """
    missing = [name for name in ("jinja2", "starlette", "uvicorn") if find_spec(name) is None]
    if missing:
        raise ValueError(
            f"the pages need {', '.join(missing)}; install them with pip install 'popl_rl[web]'"
        )
