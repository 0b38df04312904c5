"""Work for engines of tasks, in processes that import it, and an engine that runs it in the test's own."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import cv2

from datagen.fleet.engine import Ended, Task
from lanenet.errors import LanenetError


def double(number: int) -> int:
    return 2 * number


def fail(text: str) -> None:
    raise ValueError(text)


def die_times(job: tuple[Path, int]) -> str:
    """End the process without a word, the first so many times; each of them leaves a file."""
    folder, times = job
    if len(list(folder.iterdir())) < times:
        (folder / f"{os.getpid()}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def never_end(folder: Path) -> None:
    (folder / f"{os.getpid()}").touch()
    time.sleep(3600.0)


def die_or_wait(job: tuple[Path, bool]) -> None:
    """Leave a file and never end, or wait for the file of another one."""
    folder, waits = job
    if waits:
        never_end(folder)
    while not list(folder.iterdir()):
        time.sleep(0.01)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def apply(job: tuple[Callable[[Any], Any], Any]) -> Any:
    function, argument = job
    return function(argument)


def threads(_: object) -> list[object]:
    return [cv2.getNumThreads(), os.environ.get("OMP_NUM_THREADS"), os.environ.get("NUMBA_NUM_THREADS")]


def together(job: tuple[Path, str]) -> int:
    """Return how many tasks were at work at most while this one was."""
    folder, name = job
    (folder / name).touch()
    most = 0
    for _ in range(30):
        most = max(most, len(list(folder.iterdir())))
        time.sleep(0.01)
    (folder / name).unlink()
    return most


def pid_of_worker(_: object) -> int:
    return os.getpid()


class HereEngine:
    """Runs tasks in this process, one after the other."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
        for number, task in enumerate(tasks):
            self.names.append(task.name)
            try:
                ended = Ended(number, work(task.input))
            except LanenetError as error:
                ended = Ended(number, error=str(error))
            yield ended
