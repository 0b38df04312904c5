"""A car that drives until its fault comes: ``python faulty_car.py FAULT WIRE``; noted on the wire."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
from wire_log import guarded_wire, note, settings_of

from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.steering import SteeringSettings
from lanenet.errors import HardwareError
from lanenet.onboard.hardware import Frame
from lanenet.onboard.loop import DriveLoop
from lanenet.onboard.safety import CommandLimiter, LimitSettings, SafetySettings
from lanenet.perception.estimate import LaneEstimate

RATE_HZ = 30.0
#: By then the throttle has risen.
FAULT_AT = 20
LANE = LaneEstimate(np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]), confidence=1.0)
fault, wire = sys.argv[1], Path(sys.argv[2])


class Camera:
    def __init__(self) -> None:
        self.number, self.noted = -1, False

    def open(self) -> None:
        self.begin_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame | None:
        if fault == "camera gone" and self.number >= FAULT_AT:
            if not self.noted:
                note(wire, "fault")
                self.noted = True
            time.sleep(timeout_s)
            return None
        self.number += 1
        time.sleep(max(0.0, self.begin_s + self.number / RATE_HZ - time.monotonic()))
        level = self.number
        if self.number == FAULT_AT and fault.startswith("camera") and fault != "camera gone":
            note(wire, "fault")
        if self.number >= FAULT_AT:
            if fault == "camera raises":
                raise HardwareError("the camera was unplugged")
            if fault == "camera hangs":
                time.sleep(3600.0)
            if fault == "camera frozen":
                level = FAULT_AT - 1
        return Frame(np.full((24, 32, 3), level % 250, np.uint8), time.monotonic(), self.number)

    def close(self) -> None:
        pass


class Eye:
    def __init__(self) -> None:
        self.seen = -1

    def reset(self) -> None:
        pass

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        self.seen += 1
        if self.seen == FAULT_AT and not fault.startswith("camera"):
            note(wire, "fault")
        if self.seen < FAULT_AT:
            return LANE
        if fault == "network raises":
            raise RuntimeError("the network failed")
        if fault == "network answers NaN":
            return LaneEstimate(confidence=1.0)
        if fault == "network doubts":
            return LaneEstimate(LANE.points_cm, confidence=0.05)
        if fault == "loop hangs":
            # Deaf to signals, as a driver in the kernel would be.
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM, signal.SIGINT])
            time.sleep(3600.0)
        if fault == "process crashes":
            os.abort()
        if fault.startswith("SIG"):
            os.kill(os.getpid(), getattr(signal, fault))
        if fault == "guard killed":
            os.kill(sink.pid, signal.SIGKILL)
        return LANE


logging.basicConfig(level=logging.INFO)
control = ControlSettings(steering=SteeringSettings(wheelbase_cm=26.0))
faults = {"fail_at": FAULT_AT} if fault == "actuator raises" else {}
sink = guarded_wire(settings_of(wire, **faults), 0.1)
loop = DriveLoop(
    Camera(),
    Eye(),
    LaneController(control),
    sink,
    SafetySettings(countdown_s=0.0),
    CommandLimiter(LimitSettings()),
    control.speed,
    armed=True,
)
sys.exit(3 if loop.run().by_fault else 0)
