from __future__ import annotations

import os
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from wire_log import Line, guarded_wire, read_wire, settings_of

from lanenet.errors import HardwareError
from lanenet.onboard.actuators.recorder import Recorder, RecorderSettings
from lanenet.onboard.guard import GuardedActuator, StoppedError
from lanenet.onboard.neutral import CONFIRMED, SENT

WATCHDOG_S = 0.1
#: The system may wake a process late, and a busy test machine does.
LATE_S = 0.15


@pytest.fixture
def wire(tmp_path: Path) -> Path:
    return tmp_path / "wire.txt"


def guarded(wire: Path, **faults: object) -> GuardedActuator:
    return guarded_wire(settings_of(wire, **faults), WATCHDOG_S)


def drive(sink: GuardedActuator, count: int = 5, throttle: float = 0.3) -> float:
    """Send commands at 50 Hz; returns the time of the last."""
    for _ in range(count):
        last_s = time.monotonic()
        sink.send(0.1, throttle, last_s + WATCHDOG_S)
        time.sleep(0.02)
    return last_s


def wait_for(wire: Path, kind: str, after_s: float, timeout_s: float = 5.0) -> Line:
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        for line in read_wire(wire) if wire.exists() else []:
            if line.kind == kind and line.t_s >= after_s:
                return line
        time.sleep(0.01)
    raise AssertionError(f"no {kind} on the wire within {timeout_s} s")


def test_where_nothing_can_be_read_neutral_is_repeated_for_half_a_second(wire: Path) -> None:
    sink = guarded(wire, readable=False)
    sink.open()
    drive(sink)
    ended_s = time.monotonic()
    assert sink.close() == SENT
    neutral = [line.t_s for line in read_wire(wire) if line.kind == "neutral" and line.t_s > ended_s]
    assert len(neutral) > 10 and 0.4 <= neutral[-1] - neutral[0] <= 0.5 + LATE_S


@pytest.mark.slow
def test_an_idle_car_whose_neutral_is_not_confirmed_is_told(wire: Path) -> None:
    sink = guarded(wire, doubtful=True)
    sink.open()
    with pytest.raises(HardwareError, match="does not confirm neutral: no answer"):
        for _ in range(150):
            sink.idle()
            time.sleep(0.02)
    left = sink.close()
    assert left is not None and left.confirmed is False and left.why == "no answer"


def test_neutral_first_commands_then_neutral_at_the_end(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    drive(sink)
    sink.close()
    lines = read_wire(wire)
    assert [line.kind for line in lines[:2]] == ["open", "neutral"]
    assert lines[-1].kind == "close" and lines[-2].kind == "neutral"
    sent = [line for line in lines if line.kind == "send"]
    assert sent and {(line.steering_rad, line.throttle) for line in sent} == {(0.1, 0.3)}
    # Another process owns the wire, and it is gone afterwards.
    assert {line.process for line in lines} != {os.getpid()}
    assert not Path(f"/proc/{lines[0].process}").exists()


def test_a_silent_loop_runs_out(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    last_s = drive(sink)
    neutral = wait_for(wire, "neutral", last_s)
    assert WATCHDOG_S - 0.01 <= neutral.t_s - last_s <= WATCHDOG_S + LATE_S
    # A short hiccup is forgiven ...
    again_s = drive(sink)
    assert wait_for(wire, "send", again_s)
    # ... a long silence is not.
    time.sleep(1.3)
    with pytest.raises(HardwareError, match="silent for 1 s"):
        for _ in range(20):
            drive(sink, 1)
    assert not [line for line in read_wire(wire) if line.kind == "send" and line.t_s > again_s + 0.5]
    sink.close()


def test_no_command_is_good_for_longer_than_the_watchdog(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    sent_s = time.monotonic()
    sink.send(0.0, 0.2, sent_s + 60.0)
    neutral_s = wait_for(wire, "neutral", wait_for(wire, "send", sent_s).t_s).t_s
    assert neutral_s - sent_s <= WATCHDOG_S + LATE_S
    # While it holds it is repeated, for what is lost on the wire, and for a board with a watchdog of its own.
    assert len([line for line in read_wire(wire) if line.kind == "send"]) > 1
    sink.send(0.0, 0.2, time.monotonic() - 0.01)
    time.sleep(0.1)
    assert not [line for line in read_wire(wire) if line.kind == "send" and line.t_s > neutral_s]
    sink.close()


@pytest.mark.parametrize("command", [(float("nan"), 0.2), (0.0, float("nan")), (0.0, 1.5)])
def test_what_is_no_command_is_neutral(wire: Path, command: tuple[float, float]) -> None:
    sink = guarded(wire)
    sink.open()
    last_s = drive(sink)
    sink.send(*command, time.monotonic() + WATCHDOG_S)
    assert wait_for(wire, "neutral", last_s).t_s - last_s <= WATCHDOG_S
    assert not [line for line in read_wire(wire) if line.kind == "send" and line.t_s > last_s + 0.02]
    sink.close()


def test_a_failing_actuator_is_told_and_stays_neutral(wire: Path) -> None:
    sink = guarded(wire, fail_at=3)
    sink.open()
    with pytest.raises(HardwareError, match="actuator failed: Remote I/O error"):
        drive(sink, 20)
    fault = next(line for line in read_wire(wire) if line.kind == "fault")
    assert wait_for(wire, "neutral", fault.t_s).t_s - fault.t_s <= 0.05
    sink.close()
    assert not [line for line in read_wire(wire) if line.kind == "send" and line.t_s > fault.t_s]


def test_a_hung_actuator_is_told_and_set_neutral_past_its_command_and_without_its_guard(wire: Path) -> None:
    sink = guarded(wire, hang_at=3)
    sink.open()
    guard = sink.pid
    with pytest.raises(HardwareError, match="not answered"):
        drive(sink, 200)
    sink.close()
    lines = read_wire(wire)
    fault = next(line for line in lines if line.kind == "fault")
    # Within the watchdog's time, if the device itself still answers ...
    first = next(line for line in lines if line.kind == "neutral" and line.t_s > fault.t_s)
    assert first.process == guard and first.t_s - fault.t_s <= WATCHDOG_S + LATE_S
    # ... and once more from here.
    assert [line.kind for line in lines][-3:] == ["open", "neutral", "close"]
    assert lines[-1].process == os.getpid()
    # A quarter of a second without an answer tells that it hangs; from then on nobody waits for it.
    assert lines[-1].t_s - fault.t_s <= 0.25 + WATCHDOG_S + LATE_S


def test_a_guard_that_the_kernel_holds_holds_nobody_up(wire: Path) -> None:
    class Held:
        """A process that waits for its device in the kernel: no signal reaches it."""

        def __init__(self, process: subprocess.Popen[bytes]) -> None:
            self.pid = process.pid

        def kill(self) -> None:
            pass

        def wait(self, timeout: float) -> int:
            raise subprocess.TimeoutExpired("guard", timeout)

    sink = guarded(wire, hang_at=3)
    sink.open()
    process = sink._process
    assert process is not None
    sink._process = Held(process)
    try:
        with pytest.raises(HardwareError, match="not answered"):
            drive(sink, 200)
        sink.close()
        rescue = [line.kind for line in read_wire(wire) if line.process == os.getpid()]
        assert rescue == ["open", "neutral", "close"]
    finally:
        process.kill()
        process.wait()


def test_an_actuator_that_is_not_there_is_named(wire: Path) -> None:
    sink = guarded(wire, refuse="no PCA9685 at address 0x40")
    with pytest.raises(HardwareError, match="no PCA9685 at address 0x40"):
        sink.open()
    assert sink.pid == 0


def test_a_signal_while_the_guard_dies_at_its_start_is_no_traceback() -> None:
    # As after `lanenet stop`: the guard is gone, and the loop is told to end while it waits for it.
    program = (sys.executable, "-ISc", "import os, signal; os.kill(os.getppid(), signal.SIGUSR1)")
    sink = GuardedActuator("{}", lambda: Recorder(RecorderSettings()), 0.1, 1.0, program)

    def told(number: int, frame: object) -> None:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
        sink.neutral()

    before = signal.signal(signal.SIGUSR1, told)
    try:
        with pytest.raises(HardwareError, match="while it started"):
            sink.open()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert sink.pid == 0


def test_when_the_guard_is_killed_the_loop_sets_neutral(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    drive(sink)
    killed_s = time.monotonic()
    os.kill(sink.pid, signal.SIGKILL)
    with pytest.raises(HardwareError, match="died"):
        drive(sink, 20)
    assert sink.close() == CONFIRMED
    rescue = [line for line in read_wire(wire) if line.process == os.getpid()]
    assert [line.kind for line in rescue] == ["open", "neutral", "close"]
    assert rescue[-1].t_s - killed_s <= WATCHDOG_S + LATE_S


def test_a_guard_that_is_ended_goes_to_neutral_itself(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    ended_s = drive(sink)
    os.kill(sink.pid, signal.SIGTERM)
    with pytest.raises(StoppedError):
        drive(sink, 40)
    assert wait_for(wire, "close", ended_s).process != os.getpid()
    sink.close()


def test_a_guard_that_is_slow_to_end_is_not_one_that_hangs(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    drive(sink)
    # As on a busy machine: its goodbye comes long before its end of the line is closed.
    sink._take('closed [true, ""]')
    with pytest.raises(HardwareError, match="has ended"):
        drive(sink, 1)
    sink.close()
    assert os.getpid() not in {line.process for line in read_wire(wire)}
    assert read_wire(wire)[-1].kind == "close"


def test_an_idle_loop_notices_that_its_guard_died(wire: Path) -> None:
    sink = guarded(wire)
    sink.open()
    for _ in range(5):
        sink.idle()
        time.sleep(0.02)
    os.kill(sink.pid, signal.SIGKILL)
    with pytest.raises(HardwareError, match="died"):
        for _ in range(20):
            sink.idle()
            time.sleep(0.02)
    assert not [line for line in read_wire(wire) if line.kind == "send"]
    sink.close()


@pytest.fixture
def stderr_of_the_guard(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Gives guards that are started from now on another stderr."""

    def give(handle: int) -> None:
        start = subprocess.Popen
        monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: start(*a, **k, stderr=handle))

    return give


def test_a_frozen_terminal_does_not_hold_up_the_guard(
    wire: Path, stderr_of_the_guard: Callable[[int], None]
) -> None:
    master, slave = os.openpty()
    stderr_of_the_guard(slave)
    sink = guarded(wire)
    try:
        sink.open()
        termios.tcflow(slave, termios.TCOOFF)  # Ctrl-S
        last_s = drive(sink)
        # It says on the terminal that no command came ...
        wait_for(wire, "neutral", last_s)
        # ... and obeys the next ones, and ends.
        again_s = drive(sink, 20)
        assert wait_for(wire, "send", again_s)
        ended_s = time.monotonic()
        sink.close()
        assert time.monotonic() - ended_s < 1.5
        assert read_wire(wire)[-1].kind == "close"
        assert os.getpid() not in {line.process for line in read_wire(wire)}
        termios.tcflow(slave, termios.TCOON)
    finally:
        sink.close()
        os.close(master)
        os.close(slave)


def test_an_unplugged_board_is_no_traceback(
    wire: Path, tmp_path: Path, stderr_of_the_guard: Callable[[int], None]
) -> None:
    with (tmp_path / "log").open("wb") as log:
        stderr_of_the_guard(log.fileno())
        sink = guarded(wire, unplugged=True)
        sink.open()
        drive(sink)
        sink.close()
    told = (tmp_path / "log").read_text()
    assert "Input/output error" in told and "Traceback" not in told
    assert read_wire(wire)[-1].kind == "close"


def test_the_guard_imports_nothing_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pydantic", "serial", "smbus2", "json", "yaml"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('this is not the package')")
    monkeypatch.chdir(tmp_path)
    # As `export PYTHONPATH=$PYTHONPATH:/opt/...` leaves it where nothing was set before, and `python -m`.
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    sink = GuardedActuator('{"kind": "recorder"}', lambda: Recorder(RecorderSettings()), 0.1, 1.0)
    sink.open()
    sink.close()


def test_the_guard_loads_little() -> None:
    # It starts quickly, takes little memory, and nothing of the perception can hold it.
    code = (
        "import sys, lanenet.onboard.guard_process; print(*sorted(m.partition('.')[0] for m in sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "lanenet" in result.stdout.split()
    assert not {"cv2", "numpy", "onnxruntime", "pydantic", "serial", "smbus2"} & set(result.stdout.split())
