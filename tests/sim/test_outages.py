"""Neutral after an outage of the bus; `make faults` runs the whole round, `make neutral` twenty of each."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bus_wire import Wire
from outages import FAULTS, MANNERS, Case, Result, environment_of, rate_changes, run, stop_under_load

#: The system may wake a process late, and a busy test machine does: one of so many has to keep the time.
TRIES = 3


def try_outage(case: Case, folder: Path) -> Result:
    for number in range(TRIES):
        result = run(case, folder / str(number))
        if not result.wrong:
            break
    return result


@pytest.mark.parametrize("fault", FAULTS)
def test_the_motor_is_in_neutral_when_the_bus_is_back(fault: str, tmp_path: Path) -> None:
    result = try_outage(Case(fault, 0.12), tmp_path)
    assert not result.wrong, f"{result.wrong}\n{result.said}"


@pytest.mark.slow
@pytest.mark.parametrize("manner", MANNERS)
@pytest.mark.parametrize("outage_s", [0.02, 1.0, 6.0])
@pytest.mark.parametrize("fault", FAULTS)
def test_outages_short_and_long(fault: str, outage_s: float, manner: str, tmp_path: Path) -> None:
    result = try_outage(Case(fault, outage_s, manner), tmp_path)
    assert not result.wrong, f"{result.wrong}\n{result.said}"


@pytest.mark.slow
@pytest.mark.parametrize("manner", MANNERS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_bus_that_stays_away_is_said_and_has_a_code(fault: str, manner: str, tmp_path: Path) -> None:
    result = run(Case(fault, math.inf, manner), tmp_path / "bus")
    assert not result.wrong, f"{result.wrong}\n{result.said}"


def start_drive(changes: str, folder: Path) -> subprocess.Popen[bytes]:
    """Start the smallest drive with another camera; its command line is that of a drive by a car's file."""
    (folder / "car.yaml").write_text("actuator: {kind: pca9685}\n")
    code = (
        f"import signal, sys, time, neutral_times\n{changes}\n"
        'sys.exit(neutral_times.main(\'{"kind": "pca9685"}\'))'
    )
    environment = environment_of(folder)
    environment["PYTHONPATH"] += os.pathsep + str(Path(__file__).parent)
    words = [sys.executable, "-c", code, "lanenet", "drive", str(folder / "car.yaml")]
    return subprocess.Popen(words, env=environment, stderr=subprocess.PIPE)


def stop(folder: Path) -> subprocess.CompletedProcess[str]:
    Wire(folder).wait(driving=True, after_s=0.0)
    words = [sys.executable, "-m", "lanenet", "stop", str(folder / "car.yaml")]
    return subprocess.run(words, env=environment_of(folder), capture_output=True, text=True, timeout=60)


def test_a_drive_that_closes_slowly_is_still_stopped_on_purpose(tmp_path: Path) -> None:
    # A second signal, of whoever stops it, is no impatience.
    drive = start_drive("neutral_times.Camera.close = lambda _: time.sleep(1.5)", tmp_path)
    try:
        done = stop(tmp_path)
        assert done.stdout.splitlines()[0] == "neutral" and f"ended process {drive.pid}" in done.stdout
        assert drive.wait(5.0) == 0
    finally:
        drive.kill()
        drive.communicate()


@pytest.mark.slow
def test_a_drive_that_never_ends_does_not_make_neutral_doubtful(tmp_path: Path) -> None:
    # Its detector hangs, deaf to signals; the guard holds neutral, and ends when it is told to.
    deaf = """
see, seen = neutral_times.Eye.detect, []
def detect(*words):
    seen.append(words)
    if len(seen) > 20:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
        time.sleep(60.0)
    return see(*words)
neutral_times.Eye.detect = detect
"""
    drive = start_drive(deaf, tmp_path)
    try:
        done = stop(tmp_path)
        assert done.stdout.splitlines()[0] == "neutral" and f"killed process {drive.pid}" in done.stdout
        assert done.returncode == 0 and drive.wait(5.0) == -signal.SIGKILL
    finally:
        drive.kill()
        drive.communicate()


def test_another_rate_of_the_chip_is_noticed_and_mended() -> None:
    tries = [dict(rate_changes()) for _ in range(TRIES)]
    assert all(min(found[rate_hz] for found in tries) <= 0.1 for rate_hz in tries[0])


@pytest.mark.slow
def test_stop_is_quick_beside_other_work() -> None:
    assert sorted(stop_under_load(20))[-2] <= FAULTS["stop"]
