"""Time from a frame to the steering command, for whole paths as they run on the car."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.steering import SteeringSettings
from lanenet.geometry.camera import Camera
from lanenet.onboard.bench import LANE_WIDTH_CM, example_frames
from lanenet.onboard.detectors import build_detector
from lanenet.onboard.safety import CommandLimiter, LimitSettings
from lanenet.perception.estimate import Detector
from lanenet.perception.network import NetworkDetector

_WARM_UP = 10
#: Each path is timed in turns of this many frames: alone as on a car, and all over the same stretch of time.
_TURN = 50
_PERIOD_S = 1.0 / 30.0


def smaller_camera(camera: Camera, factor: int) -> Camera:
    """Return the same camera read out with a whole number fewer pixels per side."""
    K = camera.K / factor
    # Pixel centres are at integers: the corner of the image is at -0.5.
    K[:2, 2] = (camera.K[:2, 2] + 0.5) / factor - 0.5
    K[2, 2] = 1.0
    return replace(camera, width=camera.width // factor, height=camera.height // factor, K=K)


def time_paths(
    camera: Camera,
    models: Sequence[Path] = (),
    rounds: int = 300,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, dict[str, dict[str, float]]]:
    """Time each path from a frame to a limited steering command, with smoothing.

    Every path sees the same frames. At the camera's size and at half of it.

    Args:
        camera: Camera whose frames are imitated.
        models: Networks; any camera is accepted, since only their speed matters here.
        rounds: Timed frames per path.
        threads: Threads of OpenCV and onnxruntime.
        progress: Called with (frames done, frames).

    Returns:
        By size and path: ``median_ms`` and ``p99_ms`` by the clock on the wall, ``cpu_median_ms`` and
        ``cpu_p99_ms`` by that of the thread, which other work on the machine does not slow down as much.

    Raises:
        ModelMismatchError: If a model cannot be used.
        CalibrationError: If the camera sees no road.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    sizes = [camera, smaller_camera(camera, 2)]
    result: dict[str, dict[str, dict[str, float]]] = {}
    total = len(sizes) * (3 + len(models)) * rounds
    done = 0
    try:
        for used in sizes:
            frames = example_frames(used, 16, np.random.default_rng(0))
            paths = {name: _Path(d, used) for name, d in _detectors(used, models, threads).items()}
            for path in paths.values():
                path.run(frames, _WARM_UP)
                path.forget()
            for begin in range(0, rounds, _TURN):
                count = min(_TURN, rounds - begin)
                for path in paths.values():
                    path.run(frames, count)
                    done += count
                    if progress is not None:
                        progress(done, total)
            result[f"{used.width}x{used.height}"] = {name: path.figures() for name, path in paths.items()}
    finally:
        cv2.setNumThreads(before)
    return result


def _detectors(camera: Camera, models: Sequence[Path], threads: int) -> dict[str, Detector]:
    networks: dict[str, Detector] = {
        f"network {model}": NetworkDetector(model, camera, any_camera=True, threads=threads)
        for model in models
    }
    lane_filter = build_detector("lane-filter", camera, lane_width_cm=LANE_WIDTH_CM)
    others = {name: build_detector(name, camera) for name in ("hough", "painter")}
    return {**networks, "lane-filter": lane_filter, **others}


class _Path:
    """One detector with what follows it in the drive loop."""

    def __init__(self, detector: Detector, camera: Camera) -> None:
        steering = SteeringSettings(wheelbase_cm=camera.wheelbase_cm)
        self._detector = detector
        self._controller = LaneController(ControlSettings(steering=steering))
        self._limiter = CommandLimiter(LimitSettings())
        self._t_s = 0.0
        self.forget()

    def forget(self) -> None:
        """Drop the times so far."""
        self._wall_s: list[float] = []
        self._cpu_s: list[float] = []

    def run(self, frames: Sequence[UInt8[np.ndarray, "h w 3"]], count: int) -> None:
        for i in range(count):
            wall_s, cpu_s = time.perf_counter(), time.thread_time()
            estimate = self._detector.detect(frames[i % len(frames)])
            wish = self._controller.wish(estimate, self._t_s, 60.0, self._limiter.steering_rad)
            self._limiter.limit(wish.steering_rad, 0.2, self._t_s)
            self._cpu_s.append(time.thread_time() - cpu_s)
            self._wall_s.append(time.perf_counter() - wall_s)
            self._t_s += _PERIOD_S

    def figures(self) -> dict[str, float]:
        times_ms = {"": 1e3 * np.array(self._wall_s), "cpu_": 1e3 * np.array(self._cpu_s)}
        percents = {"median": 50.0, "p99": 99.0}
        return {
            f"{clock}{name}_ms": float(np.percentile(values, percent))
            for clock, values in times_ms.items()
            for name, percent in percents.items()
        }
