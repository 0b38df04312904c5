"""Time of each onboard stage on this machine.

Time from a frame to the steering command, for whole paths as they run on the car.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.steering import SteeringSettings
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.onboard.safety import CommandLimiter, LimitSettings
from lanenet.perception.detector_kind import DetectorInputs
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import Detector
from lanenet.perception.lane_filter.detector import LaneFilter, LaneFilterSettings
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.registry import build_detector, detector_names

LANE_WIDTH_CM = 40.0
_LINE_CM = 2.0
#: Each is timed from the frame to points on the road.
_EDGE_METHODS: tuple[Literal["canny", "directional", "colour"], ...] = ("canny", "directional", "colour")
_WARM_UP = 20


def example_camera() -> Camera:
    """The paper's camera: a fisheye of 170 degrees over 320 x 240 px, 20 cm up, 25 degrees down."""
    focal = 320.0 / np.deg2rad(170.0)
    K = np.array([[focal, 0.0, 159.5], [0.0, focal, 119.5], [0.0, 0.0, 1.0]])
    return Camera("fisheye", 320, 240, K, np.zeros(4), Mounting(20.0, float(np.deg2rad(25.0))), 26.0)


def example_frames(camera: Camera, count: int, rng: np.random.Generator) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Paint frames of a gently curved lane with sensor noise, each seen from elsewhere in the lane.

    The left line is yellow and the right one white, so that detectors of colour have their full work.
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    road = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(*u.shape, 2)
    near = np.nan_to_num(road, nan=1e6)
    frames = []
    for _ in range(count):
        shift, slope, bend = rng.uniform(-5.0, 5.0), rng.uniform(-0.2, 0.2), rng.uniform(-0.003, 0.003)
        x = near[..., 0] - (shift + slope * near[..., 1] + bend * near[..., 1] ** 2)
        line = np.abs(np.abs(x) - 0.5 * LANE_WIDTH_CM) < 0.5 * _LINE_CM
        gray = np.where(line & (near[..., 1] < 200.0), 220.0, 70.0) + rng.normal(0.0, 4.0, u.shape)
        frame = np.repeat(np.clip(gray, 0.0, 255.0).astype(np.uint8)[..., None], 3, axis=2)
        frame[line & (x < 0.0), 0] //= 3
        frames.append(frame)
    return frames


def time_stages(
    camera: Camera,
    model: Path | None = None,
    rounds: int = 300,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Time the stages from a frame to a lane.

    Every stage sees the same frames in turn, after a warm-up. OpenCV's plain Canny on the same frames is the
    yardstick, timed in the same run.

    Args:
        camera: Camera whose frames are imitated.
        model: Network to time as well; any camera is accepted, since only its speed matters here.
        rounds: Timed frames.
        threads: Threads of OpenCV and onnxruntime.
        progress: Called with (frames done, frames).

    Returns:
        ``stages`` (``edge stage: METHOD`` is all from the frame to points on the road): for each its
        ``median_ms``, ``p99_ms`` and ``ratio_to_canny``; ``edge_points``, ``image``,
        ``threads``, ``rounds`` and ``machine``.

    Raises:
        ModelMismatchError: If the model cannot be used.
        CalibrationError: If the camera sees no road.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        frames = example_frames(camera, 16, np.random.default_rng(0))
        network = None
        if model is not None:
            network = NetworkDetector(model, camera, any_camera=True, threads=threads)
        perception = network.meta.perception if network is not None else PerceptionSettings()
        extractor = RoadEdgeExtractor(camera, perception)
        lane_filter = LaneFilter(extractor, LaneFilterSettings(lane_width_cm=LANE_WIDTH_CM))
        window = network.meta.window if network is not None else BirdseyeWindow()
        times_ms: dict[str, list[float]] = {}
        points: list[int] = []
        for i in range(_WARM_UP + rounds):
            lap = _time_frame(frames[i % len(frames)], extractor, lane_filter, network, window, points)
            if i >= _WARM_UP:
                for stage, value in lap.items():
                    times_ms.setdefault(stage, []).append(value)
                if progress is not None:
                    progress(i + 1 - _WARM_UP, rounds)
        for method in _EDGE_METHODS:
            times_ms[f"edge stage: {method}"] = _time_edge_stage(camera, method, frames, rounds)
    finally:
        cv2.setNumThreads(before)
    yardstick = float(np.median(times_ms["canny"]))
    return {
        "stages": {
            stage: {
                "median_ms": float(np.median(values)),
                "p99_ms": float(np.percentile(values, 99)),
                "ratio_to_canny": float(np.median(values)) / yardstick,
            }
            for stage, values in times_ms.items()
        },
        "edge_points": float(np.mean(points)),
        "image": f"{camera.width}x{camera.height}",
        "threads": threads,
        "rounds": rounds,
        "machine": machine_data(),
    }


def _time_edge_stage(
    camera: Camera,
    method: Literal["canny", "directional", "colour"],
    frames: list[UInt8[np.ndarray, "h w 3"]],
    rounds: int,
) -> list[float]:
    """Time from the frame to points on the road, one method alone as on a car, [ms]."""
    extractor = RoadEdgeExtractor(camera, PerceptionSettings(edges=EdgeSettings(method=method)))
    times_ms = []
    for i in range(_WARM_UP + rounds):
        begin = time.perf_counter()
        extractor.extract(frames[i % len(frames)])
        times_ms.append(1e3 * (time.perf_counter() - begin))
    return times_ms[_WARM_UP:]


def _time_frame(
    frame: UInt8[np.ndarray, "h w 3"],
    extractor: RoadEdgeExtractor,
    lane_filter: LaneFilter,
    network: NetworkDetector | None,
    window: BirdseyeWindow,
    points: list[int],
) -> dict[str, float]:
    marks = [("", time.perf_counter())]

    def mark(stage: str) -> None:
        marks.append((stage, time.perf_counter()))

    cv2.Canny(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), 40.0, 100.0, L2gradient=True)
    mark("canny")
    table = extractor.table
    pixels = find_edges(frame, extractor.settings.edges, table.keep, table.scale, table.sample)
    mark("edges")
    road = table.lift(pixels)
    mark("lift")
    raster = window.rasterise(road.points_cm)
    mark("raster")
    lane_filter.estimate(road.points_cm, road.normals)
    mark("lane filter")
    if network is not None:
        network.detect_raster(raster)
        mark("network")
    points.append(len(road.points_cm))
    lap = {stage: 1e3 * (end - begin) for (_, begin), (stage, end) in pairwise(marks)}
    path = ("edges", "lift", "raster", "network") if network is not None else ("edges", "lift", "lane filter")
    lap["frame to lane"] = sum(lap[stage] for stage in path)
    return lap


def machine_data() -> dict[str, str | int]:
    """Return what decides timings: processor, cores, system and library versions."""
    versions = {name: metadata.version(name) for name in ("numpy", "onnxruntime")}
    return {
        "processor": _processor(),
        "architecture": platform.machine(),
        "cores": os.cpu_count() or 0,
        "system": platform.platform(),
        "python": platform.python_version(),
        "opencv": cv2.__version__,
        **versions,
    }


def _processor() -> str:
    """Name of the processor or board; the Raspberry Pi tells it in the device tree."""
    board = Path("/proc/device-tree/model")
    if board.exists():
        return board.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


_PATH_WARM_UP = 10
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
    total = len(sizes) * (len(_without_model()) + len(models)) * rounds
    done = 0
    try:
        for used in sizes:
            frames = example_frames(used, 16, np.random.default_rng(0))
            paths = {name: _Path(d, used) for name, d in _detectors(used, models, threads).items()}
            for path in paths.values():
                path.run(frames, _PATH_WARM_UP)
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
    inputs = DetectorInputs(camera=camera, lane_width_cm=LANE_WIDTH_CM)
    return networks | {name: build_detector(name, inputs) for name in _without_model()}


def _without_model() -> list[str]:
    return detector_names(lambda kind: not kind.needs_model)


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
