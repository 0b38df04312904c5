"""What every engine does: run the tasks wherever there is room, and tell how each of them ended."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

#: How often a task is begun again after its worker was lost. Chosen: machines fail now and then, and a task
#: that ends each of its workers, as for lack of memory, has to end as well.
MAX_RETRIES = 3


@dataclass(frozen=True)
class Task:
    """Something to be done by one worker.

    Attributes:
        name: For messages.
        input: What the work is called with; can be pickled.
        memory_bytes: What it takes at most, beside the other tasks of its machine.
    """

    name: str
    input: Any
    memory_bytes: int


@dataclass(frozen=True)
class Ended:
    """How a task ended.

    Attributes:
        number: Its place among the tasks.
        result: What the work returned; None if it failed.
        error: Why it failed; empty if it did not.
    """

    number: int
    result: Any = None
    error: str = ""


@runtime_checkable
class Engine(Protocol):
    """Runs tasks; knows nothing of drives."""

    def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
        """Yield each task as it ends, in any order.

        A task that raises has failed; one whose worker is lost is begun again, ``MAX_RETRIES`` times at most.
        Whoever closes the iterator ends the tasks that are running.

        Args:
            work: What to do with a task's input, in one thread; a function of a module.
            tasks: What to do it with.

        Raises:
            LanenetError: If the engine cannot be started.
        """
        ...


def reason_of(error: BaseException) -> str:
    """Say why a task failed that raised this."""
    return f"{type(error).__name__}: {error}"
