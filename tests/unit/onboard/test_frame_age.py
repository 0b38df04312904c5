"""Frames that come late, from devices with a clock, without one, and with another one."""

from __future__ import annotations

import time

import numpy as np
import pytest

from lanenet.onboard.cameras.live import CameraSettings, Capture, LiveSource
from lanenet.onboard.frame_check import FrameCheck
from lanenet.onboard.loop import DriveReport
from lanenet.onboard.safety import SafetySettings

DELAYS_S = (0.2, 0.8, 1.2, 3.0, 5.0)
CLOCKS = {
    "own": lambda: time.monotonic(),
    "time of day": lambda: time.time(),
    "camera's": lambda: time.monotonic() - 7200.0,
    "none": None,
}


class LateDevice:
    """A camera whose images are ``late_s`` old when they come."""

    name = "late camera"

    def __init__(self, late_s: float, clock: str) -> None:
        self.late_s, self.clock, self.value = late_s, CLOCKS[clock], 0

    def start(self) -> None:
        pass

    def grab(self, timeout_s: float) -> Capture:
        time.sleep(0.002)
        self.value = (self.value + 1) % 250
        stamp_s = None if self.clock is None else self.clock() - self.late_s
        return Capture(np.full((48, 64, 3), self.value, np.uint8), stamp_s)

    def stop(self) -> None:
        pass


def frames_of(device: LateDevice, n: int = 3, **settings: float):
    source = LiveSource(device, CameraSettings(width=64, height=48, **settings))
    source.open()
    try:
        for _ in range(n):
            frame = source.read(1.0)
            assert frame is not None
            yield frame, FrameCheck(SafetySettings()).fault_of(frame, time.monotonic())
    finally:
        source.close()


@pytest.mark.parametrize("late_s", DELAYS_S)
def test_late_from_the_start_by_a_clock_that_is_declared_is_old(late_s, caplog) -> None:
    for frame, fault in frames_of(LateDevice(late_s, "own")):
        assert frame.age_known and " ms old" in fault
        assert late_s <= time.monotonic() - frame.t_s < late_s + 0.5
    assert "unknown" not in caplog.text


@pytest.mark.parametrize("late_s", DELAYS_S)
@pytest.mark.parametrize("clock", ["time of day", "camera's", "none"])
def test_late_by_no_clock_or_another_one_has_no_age(late_s, clock, caplog) -> None:
    for frame, fault in frames_of(LateDevice(late_s, clock)):
        assert not frame.age_known and fault == ""
    assert caplog.text.count("age of its frames is unknown") == 1
    assert ("no time of exposure" if clock == "none" else "another clock") in caplog.text
    assert "lanenet doctor --config CAR.yaml --camera-delay" in caplog.text


@pytest.mark.parametrize("clock", ["time of day", "none"])
def test_a_delay_that_was_measured_is_the_age(clock) -> None:
    for frame, fault in frames_of(LateDevice(0.8, clock), delay_s=0.8):
        assert frame.age_known and " ms old" in fault
        assert 0.8 <= time.monotonic() - frame.t_s < 1.3
    assert all(not fault for _, fault in frames_of(LateDevice(0.02, clock), delay_s=0.02))


def test_a_camera_that_falls_back_by_minutes_stays_old() -> None:
    device = LateDevice(0.01, "own")
    seen = []
    for frame, fault in frames_of(device, n=6):
        seen.append((frame.age_known, fault))
        device.late_s = 100.0
    assert seen[0] == (True, "") and seen[-1][0] and " ms old" in seen[-1][1]


@pytest.mark.parametrize("known", [True, False])
def test_the_report_of_a_drive_claims_no_age_that_is_unknown(known) -> None:
    report = DriveReport(age_known=known)
    report.work.add(0.002)
    report.latency.add(0.03)
    text = "\n".join(report.lines())
    assert ("exposure to command" in text) == known
    assert ("age unknown, arrival to command" in text) != known
