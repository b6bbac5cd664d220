"""One process at a time: locks on folders, which tell who holds them.

A lock is the operating system's, on a hidden file that stays: it ends with the process that holds
it, however that ends, so that nobody waits for the dead. What the file says is for messages alone.
"""

import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

__all__ = ["HeldError", "held", "locked"]


class HeldError(OSError):
    """Another process holds a lock."""


@contextmanager
def held(file: Path, *, what: str) -> Iterator[None]:
    """Hold a lock, or say at once who does.

    Args:
        file: The lock; its folder exists.
        what: What is locked, and for what, for the message.

    Raises:
        HeldError: If another process, here or on another machine, holds it.
    """
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise HeldError(
            f"{what} is in use by {_holder(file)}; wait until it has ended, or end it"
        ) from None
    try:
        _sign(file)
        yield
    finally:
        lock.release()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Be the only process, on this machine or another, that makes what belongs to ``path``.

    Waits until no other process holds the lock, a hidden file beside ``path`` that stays, and says
    for whom it waits.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.parent / f".{path.name}.lock"
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        sys.stderr.write(f"waiting for {path}, which is being made by {_holder(file)}\n")
        lock.acquire()
    try:
        _sign(file)
        yield
    finally:
        lock.release()


def _sign(file: Path) -> None:
    """Say who holds a lock. Where nothing can be written, the lock holds all the same."""
    about = {"process": os.getpid(), "machine": socket.gethostname(), "since": time.time()}
    with suppress(OSError):
        file.write_text(json.dumps(about), encoding="utf-8")


def _holder(file: Path) -> str:
    """Who holds a lock, as far as its file says."""
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
        minutes = (time.time() - about["since"]) / 60
        return (
            f"process {about['process']} on {about['machine']}, for {max(minutes, 0):.0f} minutes"
        )
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
