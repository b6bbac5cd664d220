"""Ctrl-C and SIGTERM, which schedulers send before they take a machine, end a command in order.

A command that listens is ended by an exception, wherever it is, so that nothing is left half done.
Training puts SIGTERM off until a generation is done and its checkpoint written. While libraries
are imported, which some of them do not survive, the process leaves at once: there is nothing to put
in order yet.
"""

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

__all__ = ["Terminated", "importing", "is_asked_to_end", "listening", "putting_off"]


class Terminated(BaseException):
    """The process was asked to end by SIGTERM. No ``Exception``: nobody is to go on after it."""


class _State:
    """What is to be done about SIGTERM."""

    listening = False
    putting_off = False
    asked = False


@contextmanager
def listening() -> Iterator[None]:
    """Raise ``Terminated`` in the main thread at SIGTERM, for the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _on_sigterm)
    _State.listening, _State.asked = True, False
    try:
        yield
    finally:
        _State.listening = False
        signal.signal(signal.SIGTERM, before)


@contextmanager
def putting_off() -> Iterator[None]:
    """Let SIGTERM wait until the block asks, with ``is_asked_to_end``; the second one does not."""
    _State.putting_off = True
    try:
        yield
    finally:
        _State.putting_off = False


def is_asked_to_end() -> bool:
    """Whether there was a SIGTERM that was put off."""
    return _State.asked


@contextmanager
def importing(*, always: bool = False) -> Iterator[None]:
    """Leave at once at Ctrl-C or SIGTERM, for a block that imports libraries in a command.

    Nothing of them is garbage, so that none is looked for meanwhile, a second of five, and what is
    new is left out of later searches, another half.

    Args:
        always: Also before the command listens.
    """
    collects, known = gc.isenabled(), len(sys.modules)
    gc.disable()
    try:
        with _leaving(always=always):
            yield
        if len(sys.modules) > known:  # else whatever there is may well be garbage
            gc.freeze()
    finally:
        if collects:
            gc.enable()


@contextmanager
def _leaving(*, always: bool) -> Iterator[None]:
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or not (always or _State.listening):
        yield
        return
    # A command in the background, or under nohup, was told to ignore what comes.
    heeded = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    ]
    before = {number: signal.signal(number, _leave) for number in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _on_sigterm(_number: int, _frame: FrameType | None) -> None:
    if _State.putting_off and not _State.asked:
        _State.asked = True
        return
    raise Terminated


def _leave(number: int, _frame: Any) -> None:
    os.write(2, b"\ninterrupted before anything was begun\n")
    os._exit(128 + number)
