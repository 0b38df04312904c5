"""Work on many drives at once, a process for each; what kills a process is told as what it is."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from lanenet.errors import LanenetError

Progress = Callable[[int, int], None]
JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")


def run_jobs(
    work: Callable[[JobT], ResultT],
    jobs: Sequence[tuple[str, JobT]],
    workers: int,
    progress: Progress | None = None,
) -> list[ResultT]:
    """Do each job, in processes of their own if there is more than one worker and more than one job.

    Args:
        work: What to do; a function of a module, since it is sent to other processes.
        jobs: Name and input of each; the name is for people.
        workers: Processes at a time.
        progress: Called with (jobs done, jobs).

    Returns:
        The results, in the order of the jobs.

    Raises:
        LanenetError: If a process dies or the memory does not suffice; names the job, or those that were
            being done. What ``work`` raises is passed on.
    """
    # A pool starts all of its processes at once, also those that will have nothing to do.
    workers = min(workers, len(jobs))
    if workers <= 1:
        results = []
        for name, job in jobs:
            try:
                results.append(work(job))
            except MemoryError:
                raise _out_of_memory(name, 1) from None
            if progress is not None:
                progress(len(results), len(jobs))
        return results
    # Spawned, because forking a process that has started torch's or OpenCV's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_take_one_core) as pool:
        names = {pool.submit(work, job): name for name, job in jobs}
        try:
            for done, future in enumerate(as_completed(names), start=1):
                try:
                    future.result()
                except MemoryError:
                    raise _out_of_memory(names[future], workers) from None
                except BrokenProcessPool:
                    raise _died(names, workers) from None
                if progress is not None:
                    progress(done, len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [future.result() for future in names]


def _take_one_core() -> None:
    import cv2

    cv2.setNumThreads(1)


def _out_of_memory(name: str, workers: int) -> LanenetError:
    fewer = f"; fewer at a time need less ({_at_a_time(workers)})" if workers > 1 else ""
    return LanenetError(f"{name}: the memory does not suffice for this drive{fewer}")


def _at_a_time(workers: int) -> str:
    return f"now {workers}; training takes data.workers, or one per core"


def _died(names: dict[Future[ResultT], str], workers: int) -> LanenetError:
    """All jobs that are not done fail at once; begun were the first of them."""
    unfinished = [name for future, name in names.items() if _has_failed(future)]
    begun = " or ".join(unfinished[:workers])
    return LanenetError(
        f"{begun}: the process at work on this drive was killed, most often because the memory does not "
        f"suffice; fewer at a time need less ({_at_a_time(workers)}). Drives that are done are kept: run the "
        "command again"
    )


def _has_failed(future: Future[ResultT]) -> bool:
    return not future.done() or future.cancelled() or future.exception() is not None
