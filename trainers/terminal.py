"""A terminal that cannot end a run: one of few characters, one that is closed, one that is full."""

import codecs
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

__all__ = ["steady_terminal"]

#: What stands for characters that a terminal of Latin-1, cp1252 or ASCII lacks.
_PLAIN = {"−": "-", "–": "-", "—": "-", "±": "+-", "×": "x", "…": "...", "’": "'", "·": "."}
_ERRORS = "popl_rl.plain"


def _replaced(error: UnicodeError) -> tuple[str, int]:
    """Plain characters for those that cannot be written; ``?`` for most."""
    assert isinstance(error, UnicodeEncodeError)
    missing = error.object[error.start : error.end]
    return "".join(_PLAIN.get(character, "?") for character in missing), error.end


codecs.register_error(_ERRORS, _replaced)


class _Steady:
    """A stream that writes what the terminal can show, and nothing once it is gone."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_gone = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, with plain characters in the place of those that the terminal lacks."""
        if not self._is_gone:
            encoding = self._stream.encoding or "utf-8"
            try:
                try:
                    self._stream.write(text)
                except UnicodeEncodeError:
                    self._stream.write(text.encode(encoding, _ERRORS).decode(encoding))
            except (OSError, ValueError):
                self._leave()
        return len(text)

    def flush(self) -> None:
        """Flush, if anybody is still there."""
        if not self._is_gone:
            try:
                self._stream.flush()
            except (OSError, ValueError):
                self._leave()

    def _leave(self) -> None:
        self._is_gone = True
        # Python flushes at exit, and would complain of what is left.
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        except (OSError, ValueError):
            pass  # no file of the system's


@contextmanager
def steady_terminal() -> Iterator[None]:
    """Make both streams of this process steady while the block runs.

    Characters that a terminal lacks are replaced; a closed pipe (as of ``| head -1``) or a full
    disk silences what comes after it, and the command goes on to its end.
    """
    before = sys.stdout, sys.stderr
    steady: Any = tuple(_Steady(stream) for stream in before)
    sys.stdout, sys.stderr = steady
    try:
        yield
    finally:
        for stream in steady:
            stream.flush()
        sys.stdout, sys.stderr = before
