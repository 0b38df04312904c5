"""Jobs in processes: order, and what is said when a process dies."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from lanenet import processes
from lanenet.errors import LanenetError
from lanenet.processes import in_threads, run_jobs

HUGE = 2**60  # bytes


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_jobs(workers):
    seen = []
    jobs = [(str(n), n) for n in (9, 3, 7)]
    found = run_jobs(math.factorial, jobs, workers, lambda done, total: seen.append((done, total)))
    assert found == [362880, 6, 5040]
    assert seen == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_the_work_are_passed_on(workers):
    with pytest.raises(ValueError, match="factorial"):
        run_jobs(math.factorial, [("good", 3), ("bad", -1)], workers)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_lack_of_memory_names_the_drive(workers):
    with pytest.raises(LanenetError, match=r"^train_01 \(seed 5\): out of memory"):
        run_jobs(bytearray, [("train_00 (seed 4)", 8), ("train_01 (seed 5)", HUGE)], workers)


def test_a_process_that_is_killed_names_its_drives():
    jobs = [(f"train_0{k} (seed {k})", 9) for k in range(4)]
    with pytest.raises(LanenetError, match=r"train_00 \(seed 0\) or train_01 \(seed 1\): .*killed") as found:
        run_jobs(os._exit, jobs, 2)
    assert "train_03" not in str(found.value) and "data.workers" in str(found.value)


def threads_used() -> int:
    """Number of threads in which two jobs run that wait for each other for a while."""
    together = threading.Barrier(2)

    def wait(_: int) -> int:
        with contextlib.suppress(threading.BrokenBarrierError):
            together.wait(1.0)
        return threading.get_ident()

    return len(set(in_threads(wait, range(2))))


def test_threads_give_results_in_the_order_of_the_jobs(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    # A test that ran before may have done a worker's job in this process.
    monkeypatch.setattr(processes, "_ONE_THREAD", threading.Event())
    assert list(in_threads(math.factorial, (9, 3, 7))) == [362880, 6, 5040]
    assert threads_used() == 2
    with pytest.raises(ValueError, match="factorial"):
        list(in_threads(math.factorial, [3, -1]))


def test_a_worker_process_has_one_thread(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(processes, "_ONE_THREAD", threading.Event())
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(cv2, "setNumThreads", lambda _: None)
    processes.prepare_process()
    assert threads_used() == 1


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    program = (
        "import os, time\n"
        "from pathlib import Path\n"
        "from lanenet.processes import run_jobs\n"
        "if __name__ == '__main__':\n"
        f"    command = 'echo $PPID > {tmp_path}/%d; sleep 60'\n"
        "    run_jobs(os.system, [(str(k), command % k) for k in range(2)], 2)\n"
    )
    (tmp_path / "parent.py").write_text(program)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py")])
    try:
        workers = wait_for(lambda: [int(text) for k in "01" if (text := read_if_there(tmp_path / k))], 2)
        parent.kill()
        parent.wait()
        wait_for(lambda: [pid for pid in workers if not is_running(pid)], 2)
    finally:
        parent.kill()


def wait_for(found: Callable[[], list[int]], count: int) -> list[int]:
    """Ask until so many are found; fails after half a minute."""
    until = time.monotonic() + 30.0
    while len(numbers := found()) < count:
        assert time.monotonic() < until, f"found {numbers}, expected {count}"
        time.sleep(0.05)
    return numbers


def read_if_there(file: Path) -> str:
    return file.read_text() if file.is_file() else ""


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
