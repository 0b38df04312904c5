"""Tasks in processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from datagen.fleet.engine import MAX_RETRIES, Ended, Task, reason_of
from lanenet.processes import one_thread_each, prepare_process


class _Worker:
    """A process for one task after another; each has its own pool, so that its task is known if it dies."""

    def __init__(self) -> None:
        # Spawned, because forking a process that has started torch's or OpenCV's threads can hang.
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=prepare_process)
        with one_thread_each():
            self._pid = self._pool.submit(os.getpid)

    def submit(self, work: Callable[[Any], Any], task: Task) -> Future[Any]:
        return self._pool.submit(work, task.input)

    def end(self) -> None:
        """End the process, whatever it is at."""
        with suppress(BrokenProcessPool):
            pid = self._pid.result()
            for process in multiprocessing.active_children():
                if process.pid == pid:
                    process.terminate()
        self._pool.shutdown(cancel_futures=True)


def _physical_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@dataclass(frozen=True)
class LocalEngine:
    """Runs tasks in processes of this machine, as many at a time as there are workers and memory.

    Attributes:
        workers: Processes at a time.
        memory_bytes: What tasks at the same time may state together; one that states more runs alone.
    """

    workers: int = 1
    memory_bytes: int = field(default_factory=_physical_bytes)

    def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
        """Run the tasks; see :class:`datagen.fleet.engine.Engine`."""
        waiting, lost = deque(range(len(tasks))), [0] * len(tasks)
        idle = [_Worker() for _ in range(min(self.workers, len(tasks)))]
        running: dict[Future[Any], tuple[_Worker, int]] = {}
        try:
            while waiting or running:
                while waiting and idle and self._has_room(tasks, running.values(), waiting[0]):
                    worker, number = idle.pop(), waiting[0]
                    try:
                        future = worker.submit(work, tasks[number])
                    except BrokenProcessPool:  # it was killed while it waited, which says nothing of the task
                        worker.end()
                        idle.append(_Worker())
                        continue
                    waiting.popleft()
                    running[future] = (worker, number)
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker, number = running.pop(future)
                    idle.append(worker)
                    try:
                        ended = Ended(number, future.result())
                    except BrokenProcessPool:
                        worker.end()
                        idle[-1] = _Worker()
                        lost[number] += 1
                        if lost[number] <= MAX_RETRIES:
                            waiting.append(number)
                            continue
                        ended = Ended(number, error=_lost(lost[number]))
                    except Exception as error:
                        ended = Ended(number, error=reason_of(error))
                    yield ended
        finally:
            for worker in [*idle, *(worker for worker, _ in running.values())]:
                worker.end()

    def _has_room(self, tasks: Sequence[Task], running: Iterable[tuple[_Worker, int]], number: int) -> bool:
        taken = sum(tasks[busy].memory_bytes for _, busy in running)
        return not taken or taken + tasks[number].memory_bytes <= self.memory_bytes


def _lost(times: int) -> str:
    return (
        f"its process was killed {times} times, most often because memory ran out; run fewer at a time "
        "(--workers)"
    )
