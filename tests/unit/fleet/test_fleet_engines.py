"""Engines of tasks: results, failures, lost workers, memory, and an end that leaves nobody behind."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from fleet_work import die_or_wait, die_times, double, fail, is_alive, pid_of_worker, threads, together

from datagen.fleet.engine import MAX_RETRIES, Ended, Task
from datagen.fleet.local_engine import LocalEngine


def tasks_of(*inputs: object, memory_bytes: int = 1) -> list[Task]:
    return [Task(f"task {k}", item, memory_bytes) for k, item in enumerate(inputs)]


def by_number(ended: list[Ended]) -> list[Ended]:
    return sorted(ended, key=lambda each: each.number)


def test_each_task_ends_once_with_its_result():
    ended = by_number(list(LocalEngine(2).run(double, tasks_of(3, 1, 2))))
    assert ended == [Ended(0, 6), Ended(1, 2), Ended(2, 4)]


def test_no_task_needs_no_process():
    assert list(LocalEngine(2).run(double, [])) == []


def test_a_task_that_raises_stops_no_other():
    ended = by_number(list(LocalEngine(1).run(fail, tasks_of("no lane", "no light"))))
    assert [each.error for each in ended] == ["ValueError: no lane", "ValueError: no light"]


@pytest.mark.parametrize("times", [1, MAX_RETRIES])
def test_a_task_whose_worker_was_killed_is_begun_again(tmp_path: Path, times: int):
    (ended,) = LocalEngine(1).run(die_times, tasks_of((tmp_path, times)))
    assert ended == Ended(0, "done") and len(list(tmp_path.iterdir())) == times


def test_a_task_that_kills_each_of_its_workers_fails_and_others_go_on(tmp_path: Path):
    tasks = tasks_of((tmp_path, 99), (tmp_path, 0))
    bad, good = by_number(list(LocalEngine(1).run(die_times, tasks)))
    assert f"killed {MAX_RETRIES + 1} times" in bad.error and "--workers" in bad.error
    assert good == Ended(1, "done")


def test_a_worker_that_is_killed_while_it_waits_is_replaced_and_no_task_fails():
    running = LocalEngine(2, memory_bytes=1).run(pid_of_worker, tasks_of(*range(4)))
    first = next(running)
    # Only one task runs at a time, the worker that did the first may wait now.
    os.kill(first.result, signal.SIGKILL)
    assert [each.error for each in running] == [""] * 3


def test_a_worker_computes_in_one_thread(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    (ended,) = LocalEngine(1).run(threads, tasks_of(None))
    assert ended.result == [1, "1", "1"]
    assert os.environ["OMP_NUM_THREADS"] == "7" and "NUMBA_NUM_THREADS" not in os.environ


@pytest.mark.parametrize("memory_bytes", [60, 1000])
def test_tasks_that_need_more_memory_than_there_is_run_one_after_the_other(tmp_path: Path, memory_bytes: int):
    tasks = tasks_of(*((tmp_path, str(k)) for k in range(3)), memory_bytes=memory_bytes)
    ended = list(LocalEngine(2, memory_bytes=100).run(together, tasks))
    assert [each.result for each in ended] == [1, 1, 1]


def test_closing_ends_the_workers(tmp_path: Path):
    running = LocalEngine(2).run(die_or_wait, tasks_of((tmp_path, True), (tmp_path, False)))
    assert next(running).number == 1
    pids = [int(each.name) for each in tmp_path.iterdir()]
    assert len(pids) == 1 and is_alive(pids[0])
    running.close()
    end_s = time.monotonic() + 30.0
    while is_alive(pids[0]) and time.monotonic() < end_s:
        time.sleep(0.01)
    assert not is_alive(pids[0])
