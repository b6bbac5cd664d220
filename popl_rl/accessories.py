"""What a run can do without: loggers, pictures, animations, a terminal.

Results and report are what a run is for. Whatever goes wrong with the rest becomes a warning that
says what is missing, and the run goes on.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["accessory"]


@contextmanager
def accessory(missing: str, cure: str) -> Iterator[None]:
    """Do what a run can do without.

    Args:
        missing: What there will not be if the block fails, such as ``"there is no picture"``.
        cure: What to do about it.

    Warns:
        UserWarning: If the block raises anything but Ctrl-C: what is missing, why, and the cure.

    Example:
        >>> with accessory("there is no picture", cure="install a renderer"):
        ...     pass
    """
    try:
        yield
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        warnings.warn(f"{missing} ({reason}); {cure}", stacklevel=3)
