"""Jobs on several cores: in processes, where one that dies is reported with its job, and in threads."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from lanenet.errors import LanenetError

Progress = Callable[[int, int], None]
JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")

#: How often a worker process looks whether its parent is still there. Chosen: nobody waits for it.
_LOOK_EVERY_S = 1.0
#: With these in its environment from the start, a process computes in one thread: libraries read them once.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
#: Set in a worker process, whose siblings have the other cores.
_ONE_THREAD = threading.Event()


def run_jobs(
    work: Callable[[JobT], ResultT],
    jobs: Sequence[tuple[str, JobT]],
    workers: int,
    progress: Progress | None = None,
) -> list[ResultT]:
    """Run each job, in separate processes if there is more than one worker and more than one job.

    Args:
        work: What to do; a function of a module, since it is sent to other processes.
        jobs: Name, for messages, and input of each.
        workers: Processes at a time.
        progress: Called with (jobs done, jobs).

    Returns:
        The results, in the order of the jobs.

    Raises:
        LanenetError: If a process dies or memory runs out; names the job, or those that were running. What
            ``work`` raises is passed on.
    """
    # A pool starts all its processes at once, even those that would have nothing to do.
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
    with ProcessPoolExecutor(workers, mp_context=context, initializer=prepare_process) as pool:
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


def in_threads(work: Callable[[JobT], ResultT], jobs: Iterable[JobT]) -> Iterator[ResultT]:
    """Run each job, in a thread per core; for work that runs without Python's lock, as compiled loops do.

    In a worker process, whose siblings have the other cores, the jobs run one after the other.

    Yields:
        The results, in the order of the jobs.
    """
    threads = 1 if _ONE_THREAD.is_set() else os.cpu_count() or 1
    if threads == 1:
        yield from map(work, jobs)
        return
    with ThreadPoolExecutor(threads) as pool:
        try:
            yield from pool.map(work, jobs)
        finally:
            pool.shutdown(cancel_futures=True)


def prepare_process() -> None:
    """Make a worker process leave the cores to its siblings, and end at once at Ctrl-C or with its parent."""
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    use_one_thread()


def use_one_thread() -> None:
    """Make OpenCV and :func:`in_threads` compute in one thread in this process."""
    import cv2

    _ONE_THREAD.set()
    cv2.setNumThreads(1)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Make processes that are started in the block compute in one thread, whatever was set before."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with(parent: int) -> None:
    """End this process once its parent is gone: a parent that is killed tells nobody."""
    while os.getppid() == parent:
        time.sleep(_LOOK_EVERY_S)
    os._exit(1)


def _out_of_memory(name: str, workers: int) -> LanenetError:
    return LanenetError(f"{name}: out of memory" + (f"; {_fewer(workers)}" if workers > 1 else ""))


def _fewer(workers: int) -> str:
    return f"run fewer at a time (now {workers}: --workers; training takes data.workers, or one per core)"


def _died(names: dict[Future[ResultT], str], workers: int) -> LanenetError:
    """All unfinished jobs fail at once; the first of them were running."""
    unfinished = [name for future, name in names.items() if _has_failed(future)]
    running = " or ".join(unfinished[:workers])
    return LanenetError(
        f"{running}: its process was killed, most often because memory ran out; {_fewer(workers)}. What "
        "is finished is kept: run the command again"
    )


def _has_failed(future: Future[ResultT]) -> bool:
    return not future.done() or future.cancelled() or future.exception() is not None
