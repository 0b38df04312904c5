"""The Ray engine: what every engine does, on a cluster of this machine; and errors where there is none."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fleet_work import apply, die_or_wait, die_times, double, fail, is_alive, never_end, threads, together

from datagen.fleet.engine import MAX_RETRIES, Ended, Engine, Task
from datagen.fleet.ray_engine import RayEngine, _most_bytes, _python_path
from lanenet.errors import ConfigError, LanenetError, MissingExtraError

#: Ray leaves sockets to its processes when it starts and ends them.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture(autouse=True)
def no_token(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ray writes none into the home folder for a cluster that a test starts."""
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    yield
    os.environ.pop("RAY_USAGE_STATS_ENABLED", None)


def tasks_of(*inputs: object, memory_bytes: int = 1) -> list[Task]:
    return [Task(f"task {k}", item, memory_bytes) for k, item in enumerate(inputs)]


def by_number(ended: list[Ended]) -> list[Ended]:
    return sorted(ended, key=lambda each: each.number)


def test_tasks_end_with_their_results_and_a_lost_worker_is_replaced(tmp_path: Path):
    (tmp_path / "lost").mkdir()
    inputs = [(double, 3), (fail, "no lane"), (threads, None), (die_times, (tmp_path / "lost", 1))]
    tasks = [*tasks_of(*inputs), Task("more than any machine has", (double, 4), 10**15)]
    engine = RayEngine(workers=2)
    assert isinstance(engine, Engine)
    assert by_number(list(engine.run(apply, tasks))) == [
        Ended(0, 6),
        Ended(1, error="ValueError: no lane"),
        Ended(2, [1, "1", "1"]),
        Ended(3, "done"),
        Ended(4, 8),
    ]
    assert len(list((tmp_path / "lost").iterdir())) == 1
    # Nothing is sent anywhere.
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"


@pytest.mark.slow
def test_a_task_that_kills_each_of_its_workers_fails_and_others_go_on(tmp_path: Path):
    for name in ("bad", "good"):
        (tmp_path / name).mkdir()
    tasks = tasks_of((tmp_path / "bad", 99), (tmp_path / "good", 0))
    bad, good = by_number(list(RayEngine(workers=1).run(die_times, tasks)))
    assert f"lost {MAX_RETRIES + 1} times" in bad.error and "--workers" in bad.error
    assert "WorkerCrashedError" in bad.error
    assert len(list((tmp_path / "bad").iterdir())) == MAX_RETRIES + 1 and good == Ended(1, "done")


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "memory_bytes"), [(2, 10**15), (1, 1)])
def test_no_more_run_at_a_time_than_there_is_memory_or_are_allowed(
    tmp_path: Path, workers: int, memory_bytes: int
):
    tasks = tasks_of(*((tmp_path, str(k)) for k in range(3)), memory_bytes=memory_bytes)
    ended = list(RayEngine(workers=workers).run(together, tasks))
    assert [each.result for each in ended] == [1, 1, 1]


@pytest.mark.slow
def test_closing_ends_the_workers(tmp_path: Path):
    running = RayEngine(workers=2).run(die_or_wait, tasks_of((tmp_path, True), (tmp_path, False)))
    assert next(running).number == 1
    (pid,) = (int(each.name) for each in tmp_path.iterdir())
    assert is_alive(pid)
    running.close()
    end_s = time.monotonic() + 30.0
    while is_alive(pid) and time.monotonic() < end_s:
        time.sleep(0.01)
    assert not is_alive(pid)


@pytest.mark.slow
def test_a_task_that_is_always_ended_for_memory_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Ray ends workers where a machine has less left than this, and would begin again for ever."""
    monkeypatch.setenv("RAY_memory_usage_threshold", "0.001")
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "100")
    (ended,) = RayEngine(workers=1).run(never_end, tasks_of(tmp_path))
    assert ended.result is None and f"lost {MAX_RETRIES + 1} times" in ended.error
    assert "OutOfMemoryError" in ended.error


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"package ray .*pip install 'lanenet\[cluster\]'"):
        list(RayEngine().run(double, tasks_of(1)))


@pytest.mark.parametrize("address", ["nowhere", "host:port", ":6379", "ray://host:10001", "host:"])
def test_an_address_that_is_none_is_refused(address: str):
    with pytest.raises(ConfigError, match="expected HOST:PORT or auto, found"):
        list(RayEngine(address).run(double, tasks_of(1)))


def test_an_address_at_which_nobody_answers_is_refused_soon():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        begun_s = time.monotonic()
        with pytest.raises(LanenetError, match=rf"no Ray cluster answers at {address} .*ray start --head"):
            list(RayEngine(address).run(double, tasks_of(1)))
    assert time.monotonic() - begun_s < 20.0


def test_the_largest_machine_that_works_bounds_what_is_stated():
    def node(alive: bool, **has: float) -> dict[str, object]:
        return {"Alive": alive, "Resources": has}

    head, small = node(True, memory=9e9), node(True, CPU=2.0, memory=2e9)
    assert _most_bytes([head, small, node(True, CPU=1.0, memory=3e9)]) == 3_000_000_000
    assert _most_bytes([head, small, node(False, CPU=1.0, memory=3e9)]) == 2_000_000_000
    assert _most_bytes([head]) == sys.maxsize


def test_workers_look_where_this_process_finds_modules(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    own = Path(sys.prefix) / "lib" / "site-packages"
    monkeypatch.setattr(sys, "path", [str(tmp_path / "tree"), str(own), str(tmp_path / "other")])
    assert _python_path() == os.pathsep.join([str(tmp_path / "tree"), str(tmp_path / "other")])
