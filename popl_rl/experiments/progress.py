"""How far a run is: a bar for each phase on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

__all__ = ["Progress", "in_words", "is_told", "without_lines"]

_TOLD: ContextVar[bool] = ContextVar("told", default=True)
_EVERY = 10.0  # seconds between two lines of a phase


@contextmanager
def without_lines() -> Iterator[None]:
    """Have no lines written in this context: a benchmark's cell keeps its log for warnings."""
    before = _TOLD.set(False)
    try:
        yield
    finally:
        _TOLD.reset(before)


def is_told() -> bool:
    """Whether lines are to be written where there is no terminal."""
    return _TOLD.get()


class Progress:
    """A progress bar on stderr; where that is no terminal, a line every ten seconds and at the end.

    A phase that is over before its first line is due says nothing there: logs of short runs stay
    short.

    Args:
        description: What is going on.
        total: Number of generations, or of whatever is counted; None if nobody knows.
        completed: Generations done before, when a run is resumed.
        console: Where to draw; None for stderr.

    Example:
        >>> with Progress("training", total=60) as progress:  # doctest: +SKIP
        ...     progress.update(1, worst_rater_accuracy=0.61)
    """

    def __init__(
        self,
        description: str,
        *,
        total: int | None,
        completed: int = 0,
        console: Console | None = None,
    ) -> None:
        console = console or Console(stderr=True)
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[metrics]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(description, total=total, completed=completed, metrics="")
        in_lines = is_told() and not console.is_terminal
        self._lines = _Lines(description, total) if in_lines else None

    def update(self, completed: int, **fields: float) -> None:
        """Show how far it is.

        Args:
            completed: Generations done.
            fields: Scalars to show beside the bar, with ``_`` in their names read as a space.
        """
        metrics = ", ".join(f"{name.replace('_', ' ')} {x:.3g}" for name, x in fields.items())
        self._bar.update(self._task, completed=completed, metrics=metrics)
        if self._lines is not None:
            self._lines.update(completed, metrics)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
        if self._lines is not None and kind is None:
            self._lines.end()


class _Lines:
    """Lines of one phase, for a log."""

    def __init__(self, description: str, total: int | None) -> None:
        self.description, self.total = description, total
        self.began = self.last = time.monotonic()
        # What was done before is not known of a run that is resumed: the pace counts from here.
        self.first: tuple[int, float] | None = None
        self.was_told = False

    def update(self, completed: int, metrics: str) -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = completed, now
        done, spent = completed - self.first[0], now - self.first[1]
        if now - self.last < _EVERY or done < 1:
            return
        text = f"{self.description}: {completed}"
        if self.total:
            left = spent / done * (self.total - completed)
            text += f" of {self.total} ({completed / self.total:.0%}), {in_words(left)} left"
        self._say(f"{text}; {metrics}" if metrics else text)
        self.last = now

    def end(self) -> None:
        spent = time.monotonic() - self.began
        if self.was_told or spent >= _EVERY:
            self._say(f"{self.description}: done in {in_words(spent)}")

    def _say(self, text: str) -> None:
        self.was_told = True
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


def in_words(seconds: float) -> str:
    """A time as people say it, such as ``about 4 minutes``."""
    if seconds < 90:
        return f"about {max(1, round(seconds))} s"
    if seconds < 90 * 60:
        return f"about {round(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"
