"""A car that drives until its fault comes: ``python faulty_car.py FAULT WIRE``; noted on the wire.

FAULT is ``STEP raises``, ``STEP hangs`` (deaf to signals, as a driver in the kernel would be) or one of those
that are named below. The steps are those of the drive loop with the network that ships.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from wire_log import guarded_wire, note, settings_of

from lanenet.control.controller import ControlSettings, LaneController, Target
from lanenet.control.steering import SteeringSettings
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.onboard.devices import Frame
from lanenet.onboard.loop import CarParts, DriveLoop, DriveMode
from lanenet.onboard.safety import LimitSettings, SafetySettings
from lanenet.perception.edges import road as birdseye
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.network import detector as network

MODEL = Path(__file__).resolve().parents[2] / "checkpoints" / "small" / "model.onnx"
RATE_HZ = 30.0
#: By then the throttle has risen.
FAULT_AT = 20
fault, wire = sys.argv[1], Path(sys.argv[2])
camera = example_camera()
frames = example_frames(camera, 16, np.random.default_rng(0))
begun: list[int] = []


def begin() -> None:
    """Note the fault, when it begins."""
    if not begun:
        begun.append(1)
        note(wire, "fault")


def at_fault(
    step: str, answer: Callable[..., Any], faults: dict[str, Callable[..., Any]]
) -> Callable[..., Any]:
    """Return ``answer``, which from its FAULT_AT-th call on does what the fault of this step is."""
    calls = [-1]

    def raises(*_: Any, **__: Any) -> None:
        raise RuntimeError(f"{step} failed")

    def hangs(*_: Any, **__: Any) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM, signal.SIGINT])
        time.sleep(3600.0)

    wrong = {f"{step} raises": raises, f"{step} hangs": hangs, **faults}.get(fault)

    def called(*values: Any, **named: Any) -> Any:
        calls[0] += 1
        if wrong is None or calls[0] < FAULT_AT:
            return answer(*values, **named)
        begin()
        return wrong(*values, **named)

    return called


class Camera:
    """30 new frames per second."""

    def __init__(self) -> None:
        self.number = -1
        faults = {
            "camera gone": self.gone,
            "camera frozen": self.frozen,
            "camera late": lambda _: self.frame(age_s=0.2),
            "camera of another clock": lambda _: self.frame(age_s=-1000.0),
            "camera of another size": lambda _: self.frame(small=True),
        }
        self.read = at_fault("camera", lambda _: self.frame(), faults)

    def open(self) -> None:
        self.begin_s = time.monotonic()

    def frame(self, age_s: float = 0.0, picture: int | None = None, small: bool = False) -> Frame:
        self.number += 1
        time.sleep(max(0.0, self.begin_s + self.number / RATE_HZ - time.monotonic()))
        number = self.number if picture is None else picture
        # Noise of a sensor, without which the frames that come again are those of a camera that hangs.
        noise = np.random.default_rng(number).integers(0, 4, frames[0].shape, np.uint8)
        image = cv2.add(frames[number % len(frames)], noise)
        return Frame(image[::2, ::2] if small else image, time.monotonic() - age_s, self.number)

    def gone(self, timeout_s: float) -> None:
        time.sleep(timeout_s)

    def frozen(self, _: float) -> Frame:
        return self.frame(picture=FAULT_AT - 1)

    def close(self) -> None:
        pass


class Recorder:
    """Breaks its promise never to block and never to raise."""

    path, recorded, dropped = Path("nowhere"), 0, 0

    def __init__(self) -> None:
        self.add = at_fault("recorder", lambda *_, **__: None, {})

    def close(self) -> None:
        pass


class Session:
    """The network's session, until its fault."""

    def __init__(self, session: Any) -> None:
        def filled(points: float, spread: float, presence: float) -> Callable[..., Any]:
            return lambda *_: [
                np.full((1, count), value, np.float32)
                for count, value in ((6, points), (6, spread), (2, presence))
            ]

        faults = {
            "network answers NaN": filled(math.nan, math.nan, math.nan),
            "network answers infinity": filled(math.inf, 1.0, 1.0),
        }
        self.run = at_fault("network", session.run, faults)


def doubtful(*_: Any) -> float:
    return 0.05


def kill(what: Callable[[], None]) -> Callable[..., LaneEstimate]:
    def detect(frame_bgr: np.ndarray) -> LaneEstimate:
        what()
        return detect_well(frame_bgr)

    return detect


logging.basicConfig(level=logging.INFO)
control = ControlSettings(steering=SteeringSettings(wheelbase_cm=camera.wheelbase_cm))
safety = SafetySettings(countdown_s=0.0)
actuator = {"actuator raises": {"fail_at": FAULT_AT}, "actuator hangs": {"hang_at": FAULT_AT}}.get(fault, {})
sink = guarded_wire(settings_of(wire, **actuator), safety.watchdog_s)
detector = network.NetworkDetector(MODEL, camera, any_camera=True)
detector._session = Session(detector._session)  # type: ignore[assignment]
birdseye.find_edges = at_fault("edges", birdseye.find_edges, {})
network.fill_raster = at_fault("raster", network.fill_raster, {})
network.confidence = at_fault("estimate", network.confidence, {"network doubts": doubtful})
detect_well = detector.detect
ends: dict[str, Callable[..., Any]] = {
    name: kill(lambda name=name: os.kill(os.getpid(), getattr(signal, name)))  # type: ignore[misc]
    for name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
}
ends |= {
    "process crashes": kill(os.abort),
    "guard killed": kill(lambda: os.kill(sink.pid, signal.SIGKILL)),
    "guard ended": kill(lambda: os.kill(sink.pid, signal.SIGTERM)),
}
detector.detect = at_fault("detector", detect_well, ends)  # type: ignore[method-assign]
controller = LaneController(control)
lost = {"control answers NaN": lambda estimate, *_: Target(math.nan, math.nan, estimate)}
controller.target = at_fault("control", controller.target, lost)  # type: ignore[method-assign]
loop = DriveLoop(
    CarParts(Camera(), detector, controller, sink, Recorder()),
    safety,
    LimitSettings(),
    control.speed,
    DriveMode(armed=True),
)
sys.exit(3 if loop.run().by_fault else 0)
