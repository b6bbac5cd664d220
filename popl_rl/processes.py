"""Worker processes, which leave with their parent and are none of Ctrl-C's business."""

import gc
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

__all__ = ["Workers", "count_workers", "worker_pool", "workers_for"]

_Result = TypeVar("_Result")
_CURE = "if memory ran out, set fewer workers"


def count_workers(setting: str | int) -> int:
    """Processes that a setting asks for: ``"auto"`` is one for each core that this process has."""
    if setting == "auto":
        # A container or a cluster's job may have fewer than the machine; not every system tells.
        has_affinity = hasattr(os, "sched_getaffinity")
        return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return int(setting)


def worker_pool(workers: int, *, threads: int | None = None) -> ProcessPoolExecutor:
    """A pool of processes, which start when there is work.

    Args:
        workers: How many.
        threads: Torch threads of each; None where they do without torch, or choose themselves.
    """
    # Spawned: a fork of a process that has used torch's threads can hang.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin_worker, initargs=(threads,)
    )


class Workers:
    """A few processes that each keep what they are given: number k always is the same one.

    They start when the first of them is asked for something, which takes seconds.

    Args:
        count: Processes.
        threads: Torch threads of each; None where they do without torch. As many as in this process
            give results of the same bits.

    Raises:
        ValueError: If ``count`` is not positive.

    Example:
        >>> with Workers(2) as workers:  # doctest: +SKIP
        ...     halves = [workers.submit(k, sum, numbers[k::2]) for k in range(2)]
        ...     total = sum(half.result() for half in halves)
    """

    def __init__(self, count: int, *, threads: int | None = 1) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        self._pools = [worker_pool(1, threads=threads) for _ in range(count)]

    def __len__(self) -> int:
        return len(self._pools)

    def start(self) -> None:
        """Have all of them start, without waiting for it."""
        for worker in range(len(self)):
            self.submit(worker, os.getpid)

    def submit(
        self, worker: int, function: Callable[..., _Result], *arguments: Any
    ) -> "Future[_Result]":
        """Have a process call a function, after what it was asked before.

        Args:
            worker: Number of the process.
            function: Something that can be imported there.
            *arguments: What it is called with, which crosses to the other process.

        Returns:
            Its ``result()`` raises what the function raised, or ``BrokenProcessPool`` where the
            process died before the end.

        Raises:
            BrokenProcessPool: If the process has died before.
        """
        try:
            return self._pools[worker].submit(function, *arguments)
        except BrokenProcessPool as error:
            raise BrokenProcessPool(f"worker process {worker} was killed; {_CURE}") from error

    def close(self) -> None:
        """End the processes; of what they were asked, they do no more than one or two things."""
        for pool in self._pools:
            pool.shutdown(cancel_futures=True)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def workers_for(setting: str | int, *, threads: int) -> Iterator[Workers | None]:
    """The processes that a setting asks for, for the block; None where this one is enough.

    Args:
        setting: See ``count_workers``.
        threads: Torch threads of each.

    Raises:
        ValueError: If ``setting`` is not positive.
        BrokenProcessPool: If one of them dies and the block needs it; with what to do about it.
    """
    count = count_workers(setting)
    if count == 1:
        yield None
        return
    try:
        with Workers(count, threads=threads) as workers:
            yield workers
    except BrokenProcessPool as error:
        raise BrokenProcessPool(f"a worker process was killed; {_CURE}") from error


def _begin_worker(threads: int | None) -> None:
    """Leave Ctrl-C to the parent, and leave with the parent, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    # What they are asked for imports a million objects, none of which is garbage: a second of five.
    gc.set_threshold(100_000, 20, 100)
    if threads is not None:
        import torch  # which takes seconds that a pool of other work need not wait for

        torch.set_num_threads(threads)


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
