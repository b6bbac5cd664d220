"""Jobs in worker processes that wait for each other. One that fails stops only who needs it."""

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from popl_rl.processes import worker_pool

__all__ = ["Job", "run_jobs"]

Work = Callable[[Any], str | None]


@dataclass(frozen=True)
class Job:
    """Something to do.

    Attributes:
        name: Name, of which there is one.
        argument: What the work is called with; it crosses to another process.
        after: Name of the job that must have succeeded before; None for none.
    """

    name: str
    argument: Any
    after: str | None = None


def run_jobs(
    jobs: Sequence[Job],
    work: Work,
    *,
    workers: int,
    on_done: Callable[[str, str | None], None] = lambda _name, _error: None,
) -> dict[str, str]:
    """Do all jobs, as many at a time as there are workers.

    Args:
        jobs: What to do, in this order as far as waiting allows. A job that others wait for and
            that is not among ``jobs`` counts as done.
        work: Called with a job's argument; returns None, or what went wrong. Workers import it.
        workers: Worker processes; 0 to work in this process.
        on_done: Called with the name of every job that has ended, and what went wrong or None.

    Returns:
        What went wrong, by name of the job.

    Raises:
        ValueError: If ``workers`` is negative, or jobs wait for each other in a circle.
    """
    if workers < 0:
        raise ValueError(f"workers must be at least 0, got {workers}; 0 works in this process")
    failures: dict[str, str] = {}

    def end(job: Job, error: str | None) -> None:
        if error is not None:
            failures[job.name] = error
        on_done(job.name, error)

    others = multiprocessing.active_children()
    waiting = list(jobs)
    running: dict[Future[str | None], tuple[Job, Executor]] = {}
    pool = _pool(workers)
    try:
        while waiting or running:
            while job := next((job for job in waiting if job.after in failures), None):
                waiting.remove(job)
                end(job, f"{job.after} failed, which it needs")
            unfinished = {job.name for job in waiting} | {job.name for job, _ in running.values()}
            ready = [job for job in waiting if job.after not in unfinished]
            if not ready and not running and waiting:
                raise ValueError(f"jobs wait for each other in a circle: {sorted(unfinished)}")
            # No more than can start at once: what is in the pool's own queue is hard to take back.
            for job in ready[: max(workers, 1) - len(running)]:
                waiting.remove(job)
                try:
                    future = pool.submit(work, job.argument)
                except BrokenProcessPool:  # a worker died that had nothing to do
                    pool = _pool(workers)
                    future = pool.submit(work, job.argument)
                running[future] = job, pool
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, its_pool = running.pop(future)
                error = future.exception()
                if error is None:
                    end(job, future.result())
                elif isinstance(error, BrokenProcessPool):
                    end(job, "its process was killed; if memory ran out, use fewer workers")
                    if its_pool is pool:
                        pool.shutdown()
                        pool = _pool(workers)
                else:
                    end(job, f"{type(error).__name__}: {error}")
    except BaseException:
        # Workers do not hear Ctrl-C, and would finish what they are at.
        for child in multiprocessing.active_children():
            if child not in others:
                child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
    return failures


class _Here(Executor):
    """Does everything at once, in this process."""

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **options))
        except Exception as error:
            future.set_exception(error)
        return future


def _pool(workers: int) -> Executor:
    if workers == 0:
        return _Here()
    return worker_pool(workers)
