from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from wire_log import Line, read_wire

HERE = Path(__file__).parent
#: Exit code of a loop that has to be killed, and of one that stopped for a fault.
HUNG, BY_FAULT = None, 3
STEPS = ("camera", "edges", "raster", "network", "estimate", "detector", "control", "recorder")
#: Fault, exit code of the loop, and what its log says.
FAULTS: dict[str, tuple[int | None, str]] = {
    **{f"{step} raises": (1, f"{step} failed") for step in STEPS},
    **{f"{step} hangs": (HUNG, "no command from the drive loop") for step in STEPS},
    "camera gone": (BY_FAULT, "no frame from the camera"),
    "camera frozen": (BY_FAULT, "the camera hangs"),
    "camera late": (BY_FAULT, "ms old"),
    "camera of another clock": (BY_FAULT, "ahead of the clock"),
    "camera of another size": (1, "160x120 px, but the camera is calibrated for 320x240"),
    "network answers NaN": (BY_FAULT, "no lane in frame"),
    "network answers infinity": (BY_FAULT, "no lane in frame"),
    "network doubts": (BY_FAULT, "confidence 0.05"),
    "control answers NaN": (BY_FAULT, "no lane in frame"),
    "process crashes": (-signal.SIGABRT, "the drive loop is gone"),
    "actuator raises": (1, "Remote I/O error"),
    "actuator hangs": (1, "has not answered for 0.25 s"),
    "guard killed": (1, "died"),
    "guard ended": (0, "neutral: stopped from outside"),
    "SIGKILL": (-signal.SIGKILL, "the drive loop is gone"),
    "SIGTERM": (0, "neutral: SIGTERM"),
    "SIGINT": (0, "neutral: SIGINT"),
    "SIGHUP": (0, "neutral: SIGHUP"),
}
#: Which step of the loop raises or hangs makes no difference to what happens; the unit tests of the frame
#: check, the safety judge and the signals cover the other faults.
SLOW = {
    *(
        f"{step} {what}"
        for step in ("edges", "raster", "estimate", "detector")
        for what in ("raises", "hangs")
    ),
    *("control raises", "network hangs", "control hangs"),
    *("camera late", "camera of another clock", "camera of another size"),
    *("camera frozen", "network answers NaN", "network answers infinity", "control answers NaN", "SIGINT"),
}
#: Neutral this long after the fault, read from the wire; nothing is allowed for the machine.
ALLOWED_S = 0.1
#: A driver that hangs holds the guard as well: the loop waits 0.25 s for an answer, until its next turn.
ALLOWED_HUNG_DRIVER_S = 0.3
#: A loop that hangs is watched this long after its fault: chosen, half as long again as one that is in order
#: takes to stop for good (``end_after_s``, 1 s).
WATCHED_S = 1.5
#: Other work on the machine may wake a process late: one of so many drives has to keep the time.
TRIES = 3


def is_neutral(line: Line) -> bool:
    return line.kind in ("neutral", "close") or (line.kind == "send" and line.throttle == 0.0)


def wait_for_end(wire: Path, process: subprocess.Popen[str], hangs: bool) -> None:
    """Let the drive go on until it ends, or until some time after the fault if it hangs."""
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s and process.poll() is None:
        faults = [line for line in read_wire(wire) if line.kind == "fault"] if wire.exists() else []
        if hangs and faults and time.monotonic() - faults[0].t_s > WATCHED_S:
            return
        time.sleep(0.02)


def wait_for_guard(wire: Path, log: Path, told: str) -> None:
    """The guard goes after its loop, and says why after it has closed its actuator."""
    end_s = time.monotonic() + 5.0
    while time.monotonic() < end_s and (read_wire(wire)[-1].kind != "close" or told not in log.read_text()):
        time.sleep(0.02)


@dataclass(frozen=True)
class Drive:
    code: int | None
    log: str
    lines: list[Line]

    @property
    def fault_s(self) -> float:
        return next(line.t_s for line in self.lines if line.kind == "fault")

    @property
    def neutral_s(self) -> float:
        return next(line.t_s for line in self.lines if line.t_s >= self.fault_s and is_neutral(line))


def drive_into(fault: str, folder: Path) -> Drive:
    wire, log = folder / "wire.txt", folder / "log.txt"
    expected, told = FAULTS[fault]
    folder.mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])}
    with log.open("w") as stream:
        process = subprocess.Popen(
            [sys.executable, str(HERE / "faulty_car.py"), fault, str(wire)],
            stdout=stream,
            stderr=stream,
            text=True,
            env=environment,
        )
        try:
            wait_for_end(wire, process, hangs=expected is HUNG)
            code = process.poll()
        finally:
            process.kill()
            process.wait()
    wait_for_guard(wire, log, told)
    return Drive(code, log.read_text(), read_wire(wire))


@pytest.mark.usefixtures("hang_up_ends")
@pytest.mark.parametrize(
    "fault", [pytest.param(fault, marks=[pytest.mark.slow] if fault in SLOW else []) for fault in FAULTS]
)
def test_every_fault_ends_in_neutral(
    fault: str, tmp_path: Path, record_property: pytest.RecordProperty
) -> None:
    code, told = FAULTS[fault]
    allowed_s = ALLOWED_HUNG_DRIVER_S if fault == "actuator hangs" else ALLOWED_S
    after_s = []
    for number in range(TRIES):
        drive = drive_into(fault, tmp_path / str(number))
        moving = [line for line in drive.lines if line.kind == "send" and line.throttle > 0.0]
        assert any(line.throttle > 0.2 for line in moving), "the car did not drive before the fault"
        assert moving[-1].t_s <= drive.neutral_s, "the motor was driven again"
        assert is_neutral(drive.lines[-1]) and drive.lines[-1].kind == "close"
        assert drive.code == code
        assert told in drive.log
        after_s.append(drive.neutral_s - drive.fault_s)
        if after_s[-1] <= allowed_s:
            break
    record_property("neutral_after_ms", [round(1e3 * value, 1) for value in after_s])
    assert min(after_s) <= allowed_s
