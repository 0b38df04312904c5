from __future__ import annotations

import logging
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lanenet.data.drives.recorder import DriveRecorder
from lanenet.onboard.arming import ArmCheck, ArmGate, HoldFile
from lanenet.onboard.devices import Frame
from lanenet.perception.camera_check import CameraCheck

FITS = ArmCheck("model", True, "fits")


def frame(number: int) -> Frame:
    return Frame(np.full((8, 8, 3), number, np.uint8), number / 30.0, number)


class Views(CameraCheck):
    """Shows the same pitch error in every view."""

    def __init__(self, pitch_deg: float) -> None:
        self._pitch_deg = pitch_deg

    def view(self, frame_bgr: np.ndarray) -> tuple[float, float]:
        return math.radians(self._pitch_deg), 0.0


class Card(DriveRecorder):
    def __init__(self, problem: str = "", recorded: int = 0) -> None:
        self.path, self.problem, self.recorded = Path("drives"), problem, recorded


def faults(gate: ArmGate, count: int = 30, fault: str = "", confidence: float = 1.0) -> list[str]:
    return [gate.fault_of(frame(i), fault, confidence, i / 30.0) for i in range(count)]


def test_ten_good_frames_let_the_car_start_and_are_listed(caplog: pytest.LogCaptureFixture) -> None:
    gate = ArmGate(FITS, 0.5, Card(recorded=1), camera_check=Views(1.0))
    with caplog.at_level(logging.INFO):
        seen = faults(gate)
    assert all(seen[:9]) and not any(seen[9:])
    names = ["model", "frames", "actuator", "lane", "recording", "calibration"]
    assert [check.name for check in gate.checks] == names and all(check.passed for check in gate.checks)
    assert [line.split("pass  ")[1].split(":")[0] for line in caplog.messages] == names


@pytest.mark.parametrize(
    ("gate", "options", "name"),
    [
        (lambda: ArmGate(ArmCheck("model", False, "x"), 0.5), {}, "model"),
        (lambda: ArmGate(FITS, 0.5), {"fault": "frame 3 is 300 ms old"}, "frames"),
        (lambda: ArmGate(FITS, 0.5), {"confidence": 0.4}, "lane"),
        (lambda: ArmGate(FITS, 0.5), {"confidence": math.nan}, "lane"),
        (lambda: ArmGate(FITS, 0.5, Card("the card is full", 1)), {}, "recording"),
        (lambda: ArmGate(FITS, 0.5, Card()), {}, "recording"),
        (lambda: ArmGate(FITS, 0.5, None, Views(20.0)), {}, "calibration"),
        (lambda: ArmGate(FITS, 0.5, hold=HoldFile(Path("/nowhere/key"))), {}, "hold"),
    ],
)
def test_what_fails_keeps_the_car_and_is_named(
    gate: Any, options: dict[str, Any], name: str, caplog: pytest.LogCaptureFixture
) -> None:
    made = gate()
    with caplog.at_level(logging.WARNING):
        seen = faults(made, 120, **options)
    assert all(name in fault for fault in seen[10:])
    assert name in [check.name for check in made.checks if not check.passed]
    # Once, after three seconds.
    assert sum(f"FAIL  {name}" in line for line in caplog.messages) == 1


def test_a_slow_camera_has_turns_without_a_frame() -> None:
    gate = ArmGate(FITS, 0.5)
    for i in range(10):
        fault = gate.fault_of(frame(i), "", 1.0, 0.1 * i)
        assert bool(gate.fault_of(None, "no frame", math.nan, 0.1 * i + 0.05)) is bool(fault) is (i < 9)
    silent = ArmGate(FITS, 0.5)
    assert all(silent.fault_of(None if i % 2 else frame(i), "", 1.0, 0.4 * i) for i in range(40))


def test_a_frame_that_fails_starts_the_count_again() -> None:
    gate = ArmGate(FITS, 0.5)
    faults(gate, 9)
    assert gate.fault_of(frame(9), "late", 1.0, 0.3) and gate.fault_of(frame(10), "", 1.0, 0.4)


def test_a_file_that_is_removed_lets_go(tmp_path: Path) -> None:
    key = tmp_path / "key"
    hold = HoldFile(key)
    assert "key" in hold.fault
    key.touch()
    assert hold.fault == ""
    key.unlink()
    assert "key" in hold.fault


@pytest.mark.parametrize("fresh_s", [None, 5.0])
def test_only_a_plain_file_holds_the_car(tmp_path: Path, fresh_s: float | None) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (tmp_path, pipe, Path("/dev/null")):
        hold = HoldFile(path, fresh_s)
        for i in range(2):
            if path == tmp_path:
                (tmp_path / f"other{i}").touch()
            assert str(path) in hold.fault


def test_a_file_has_to_be_touched(tmp_path: Path) -> None:
    now_s, key = [0.0], tmp_path / "key"
    key.touch()
    hold = HoldFile(key, 0.5, lambda: now_s[0])
    # One that was there before may have been forgotten.
    assert "0.5 s" in hold.fault
    for i in range(4):
        # Any other time: clocks may be set while the car drives.
        os.utime(key, (1000.0 - i, 1000.0 - i))
        now_s[0] += 0.4
        assert hold.fault == ""
    now_s[0] += 0.6
    assert "0.5 s" in hold.fault
