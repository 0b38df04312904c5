"""Tasks on a Ray cluster: on the machines of one that is running, or on one of this machine alone."""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.fleet.engine import MAX_RETRIES, Ended, Task, reason_of
from lanenet.data.files import require
from lanenet.errors import ConfigError, LanenetError
from lanenet.processes import ONE_THREAD, use_one_thread

#: The address of the cluster that this machine is part of.
AUTO = "auto"
#: Most tasks that Ray is given at a time, to run or to queue. Chosen: more than the cores of a large cluster.
_MOST_GIVEN = 1000
#: Of Ray's store of objects, [bytes], which it would else give 30 % of the memory; tasks return a few words.
#: Ray takes no less than 75 MB.
_STORE_BYTES = 80_000_000
#: What a worker of Ray takes beside the work, [bytes]. Measured for 1200 frames: 972 MB in a worker with its
#: second drive, 695 MB in a process of its own.
_WORKER_BYTES = 300_000_000
#: How long a head node may take to answer, and workers to end when a run is given up, [s]. Chosen.
_ANSWER_S, _END_S = 5.0, 30.0


@dataclass(frozen=True)
class RayEngine:
    """Runs each task on a core of the cluster that has the memory for it.

    Attributes:
        address: ``host:port`` of a cluster that this machine is part of, or ``auto``; None starts a cluster
            of this machine, which ends with the run.
        workers: Most tasks at a time; None for the cores that there are.
    """

    address: str | None = None
    workers: int | None = None

    def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
        """Run the tasks; see :class:`datagen.fleet.engine.Engine`.

        Raises:
            ConfigError: If the address is none.
            MissingExtraError: If Ray is not installed.
            LanenetError: If the cluster does not answer.
        """
        with self._cluster() as ray, closing(_attempts(ray, work, tasks, self.workers)) as ended:
            yield from ended

    @contextmanager
    def _cluster(self) -> Iterator[Any]:
        """Connect to the cluster, or start one, for the block."""
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # read when a cluster starts; nothing is sent anywhere
        ray = require("ray", "cluster")
        here: dict[str, Any] = {}
        if self.address is None:
            cores = self.workers or os.cpu_count() or 1
            here = {"num_cpus": cores, "include_dashboard": False, "object_store_memory": _STORE_BYTES}
        elif self.address != AUTO:
            _check_answers(self.address)
        logging.getLogger("ray").setLevel(logging.ERROR)
        try:
            ray.init(
                self.address or "local",
                runtime_env={"env_vars": {**ONE_THREAD, "PYTHONPATH": _python_path()}},
                log_to_driver=False,
                logging_level=logging.ERROR,
                **here,
            )
        except (ConnectionError, RuntimeError, TimeoutError, ValueError, ray.exceptions.RayError) as error:
            where = f"at {self.address}" if self.address else "of this machine"
            raise LanenetError(f"the Ray cluster {where} cannot be used: {error}") from None
        try:
            yield ray
        finally:
            ray.shutdown()


def _attempts(
    ray: Any, work: Callable[[Any], Any], tasks: Sequence[Task], workers: int | None
) -> Generator[Ended, None, None]:
    """Yield the tasks as they end; Ray's own retries are off, as they have no end where memory runs out."""
    attempt, most_bytes = ray.remote(_attempt), _most_bytes(ray.nodes())
    waiting, lost = deque(range(len(tasks))), [0] * len(tasks)
    running: dict[Any, int] = {}
    try:
        while waiting or running:
            while waiting and len(running) < (workers or _MOST_GIVEN):
                number = waiting.popleft()
                task = tasks[number]
                # No machine would ever take a task that states more than all have; it gets a machine alone.
                memory = min(task.memory_bytes + _WORKER_BYTES, most_bytes)
                given = attempt.options(num_cpus=1, memory=memory, max_retries=0, name=task.name)
                running[given.remote(work, task.input)] = number
            (ref,), _ = ray.wait(list(running), num_returns=1)
            number = running.pop(ref)
            try:
                result, error = ray.get(ref)
            except ray.exceptions.RayTaskError as failed:  # before the work began, as for want of a module
                result, error = None, reason_of(failed.cause)
            except ray.exceptions.RayError as failed:
                lost[number] += 1
                if lost[number] <= MAX_RETRIES:
                    waiting.append(number)
                    continue
                result, error = None, _lost(lost[number], failed)
            yield Ended(number, result, error)
    finally:
        _end(ray, list(running))


def _attempt(work: Callable[[Any], Any], task_input: Any) -> tuple[Any, str]:
    """Work in a worker; returns the result, and the reason if there is none."""
    use_one_thread()
    try:
        return work(task_input), ""
    except Exception as error:
        return None, reason_of(error)


def _end(ray: Any, running: list[Any]) -> None:
    """End tasks, whatever they are at, so that nobody writes any more."""
    for ref in running:
        ray.cancel(ref, force=True)
    if running:
        ray.wait(running, num_returns=len(running), timeout=_END_S)


def _most_bytes(nodes: Sequence[dict[str, Any]]) -> int:
    """Return what the machine with the most memory has to give, [bytes]."""
    given = [node["Resources"] for node in nodes if node["Alive"]]
    # A head node without cores works on nothing; others may still be starting.
    working = [int(has.get("memory", 0)) for has in given if has.get("CPU", 0) >= 1]
    return max(working, default=sys.maxsize)


def _python_path() -> str:
    """Return where this process finds modules beside Python's own, as in a working tree; so do workers."""
    own = {Path(prefix).resolve() for prefix in (sys.prefix, sys.base_prefix)}
    found = [Path(entry).resolve() for entry in sys.path]
    return os.pathsep.join(str(path) for path in found if not own.intersection((path, *path.parents)))


def _check_answers(address: str) -> None:
    """Refuse an address at which nobody answers: Ray itself would try for many minutes."""
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        raise ConfigError(f"--address: expected HOST:PORT or {AUTO}, found {address!r}")
    try:
        socket.create_connection((host, int(port)), _ANSWER_S).close()
    except (OSError, OverflowError) as error:
        raise LanenetError(
            f"no Ray cluster answers at {address} ({error}); start one with: ray start --head"
        ) from None


def _lost(times: int, error: Exception) -> str:
    first = next(iter(str(error).splitlines()), "")
    return (
        f"its worker was lost {times} times, most often because memory ran out; run fewer at a time "
        f"(--workers). Ray says: {type(error).__name__}: {first}"
    )
