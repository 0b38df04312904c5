"""Timings on this machine: each onboard stage, and whole paths from a frame to the steering command."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
from lanenet.perception.edges.canny import EdgeSettings
from lanenet.perception.edges.raster import PLANES, fill_raster, new_raster
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import Detector, DetectorInputs
from lanenet.perception.lane_filter import LaneFilter, LaneFilterSettings
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.registry import build_detector, detector_names

#: The example road: a common lane of 1:10 tracks, marked with 2 cm tape.
LANE_WIDTH_CM = 40.0
_LINE_CM = 2.0
#: Different frames in turn, so that no stage finds its last answer in a cache; chosen: 16 take 4 MB.
_FRAMES = 16
#: Each is timed from the frame to points on the road.
_EDGE_METHODS: tuple[Literal["canny", "directional", "colour"], ...] = ("canny", "directional", "colour")
#: Frames before the timed ones, for stages and for paths; chosen: the first few fill caches and thread pools.
_WARM_UP = 20
_PATH_WARM_UP = 10
#: Paths take turns of this many frames: long enough to run alone as on a car, short enough that a change of
#: the machine's load meets all of them.
_TURN = 50
#: Time between two frames as the controller sees it, [s].
_PERIOD_S = 1.0 / 30.0


def time_stages(
    camera: Camera,
    model: Path | None = None,
    rounds: int = 300,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Time the stages from a frame to a lane.

    Every stage gets the same frames, after a warm-up. The yardstick is OpenCV's plain Canny on these frames.

    Args:
        camera: Camera whose frames are imitated.
        model: Network to time as well; with any camera, since only its speed matters here.
        rounds: Timed frames.
        threads: Threads of OpenCV and onnxruntime; compiled loops have one.
        progress: Called with (frames done, frames).

    Returns:
        ``stages``: ``median_ms``, ``p99_ms`` and ``ratio_to_canny`` of each; ``edge stage: METHOD`` is
        everything from the frame to points on the road. Also ``edge_points``, ``image``, ``threads``,
        ``rounds`` and ``machine``.

    Raises:
        ModelMismatchError: If the model cannot be used.
        CalibrationError: If the camera sees no road.
    """
    with _opencv_threads(threads):
        frames = example_frames(camera, _FRAMES, np.random.default_rng(0))
        network = None
        if model is not None:
            network = NetworkDetector(model, camera, any_camera=True, threads=threads)
        stages = _Stages(camera, network)
        times_ms: dict[str, list[float]] = {}
        points: list[int] = []
        for i in range(_WARM_UP + rounds):
            lap_ms, count = stages.time(frames[i % len(frames)])
            points.append(count)
            if i >= _WARM_UP:
                for stage, value in lap_ms.items():
                    times_ms.setdefault(stage, []).append(value)
                if progress is not None:
                    progress(i + 1 - _WARM_UP, rounds)
        for method in _EDGE_METHODS:
            times_ms[f"edge stage: {method}"] = _time_edge_stage(camera, method, frames, rounds)
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


def time_paths(
    camera: Camera,
    models: Sequence[Path] = (),
    rounds: int = 300,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, dict[str, dict[str, float]]]:
    """Time each path from a frame to a limited steering command, at the camera's size and at half of it.

    Args:
        camera: Camera whose frames are imitated; every path gets the same ones.
        models: Networks; with any camera, since only their speed matters here.
        rounds: Timed frames per path.
        threads: Threads of OpenCV and onnxruntime; compiled loops have one.
        progress: Called with (frames done, frames).

    Returns:
        By size and path: ``median_ms`` and ``p99_ms`` of wall-clock time, ``cpu_median_ms`` and
        ``cpu_p99_ms`` of the thread's CPU time, which depends less on the load of the machine, and
        ``ratio_to_canny`` of the CPU medians. The path ``canny`` is the yardstick: plain Canny alone, in turn
        with the others.

    Raises:
        ModelMismatchError: If a model cannot be used.
        CalibrationError: If the camera sees no road.
    """
    result: dict[str, dict[str, dict[str, float]]] = {}
    done = 0
    with _opencv_threads(threads):
        for used in (camera, smaller_camera(camera, 2)):
            frames = example_frames(used, _FRAMES, np.random.default_rng(0))
            paths = {"canny": _Path(plain_canny)}
            for name, detector in _detectors(used, models, threads).items():
                paths[name] = _Path(_Drive(detector, used).step)
            for path in paths.values():
                path.run(frames, _PATH_WARM_UP)
                path.forget()
            for begin in range(0, rounds, _TURN):
                count = min(_TURN, rounds - begin)
                for path in paths.values():
                    path.run(frames, count)
                    done += count
                    if progress is not None:
                        progress(done, 2 * len(paths) * rounds)
            figures = {name: path.figures() for name, path in paths.items()}
            for values in figures.values():
                values["ratio_to_canny"] = values["cpu_median_ms"] / figures["canny"]["cpu_median_ms"]
            result[f"{used.width}x{used.height}"] = figures
    return result


def example_camera() -> Camera:
    """Return the paper's camera: a fisheye of 170 degrees, 320 x 240 px, 20 cm high, 25 degrees down."""
    focal = 320.0 / np.deg2rad(170.0)
    K = np.array([[focal, 0.0, 159.5], [0.0, focal, 119.5], [0.0, 0.0, 1.0]])
    return Camera("fisheye", 320, 240, K, np.zeros(4), Mounting(20.0, float(np.deg2rad(25.0))), 26.0)


def example_frames(camera: Camera, count: int, rng: np.random.Generator) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Draw frames of a gently curved lane with sensor noise, each from another place in the lane.

    The left line is yellow and the right one white, so that detectors that use colour do all their work.
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


def smaller_camera(camera: Camera, factor: int) -> Camera:
    """Return the same camera downsampled by a whole factor."""
    K = camera.K / factor
    # Pixel centres are at integers: the corner of the image is at -0.5.
    K[:2, 2] = (camera.K[:2, 2] + 0.5) / factor - 0.5
    K[2, 2] = 1.0
    return replace(camera, width=camera.width // factor, height=camera.height // factor, K=K)


def machine_data() -> dict[str, str | int]:
    """Return what timings depend on: processor, cores, system and library versions."""
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
    """Return the name of the processor, or of the board, which a Raspberry Pi has in its device tree."""
    board = Path("/proc/device-tree/model")
    if board.exists():
        return board.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


@contextmanager
def _opencv_threads(threads: int) -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


class _Stages:
    """The stages from a frame to a lane, timed one by one."""

    def __init__(self, camera: Camera, network: NetworkDetector | None) -> None:
        perception = PerceptionSettings() if network is None else network.meta.perception
        self._extractor = RoadEdgeExtractor(camera, perception)
        self._lane_filter = LaneFilter(self._extractor, LaneFilterSettings(lane_width_cm=LANE_WIDTH_CM))
        self._network = network
        self._window = BirdseyeWindow() if network is None else network.meta.window
        self._raster = new_raster(self._window, len(PLANES) if network is None else network.meta.planes)

    def time(self, frame: UInt8[np.ndarray, "h w 3"]) -> tuple[dict[str, float], int]:
        """Return the time of each stage on a frame, [ms], and the number of edge points on the road."""
        marks = [("", time.perf_counter())]

        def mark(stage: str) -> None:
            marks.append((stage, time.perf_counter()))

        plain_canny(frame)
        mark("canny")
        table = self._extractor.table
        pixels = table.find(frame, self._extractor.settings.edges)
        mark("edges")
        road = table.lift(pixels)
        mark("lift")
        raster = fill_raster(self._window, road, self._raster)
        mark("raster")
        self._lane_filter.estimate(road.points_cm, road.normals)
        mark("lane filter")
        path: tuple[str, ...] = ("edges", "lift", "lane filter")
        if self._network is not None:
            self._network.detect_raster(raster)
            mark("network")
            path = ("edges", "lift", "raster", "network")
        lap_ms = {stage: 1e3 * (end - begin) for (_, begin), (stage, end) in pairwise(marks)}
        lap_ms["frame to lane"] = sum(lap_ms[stage] for stage in path)
        return lap_ms, len(road.points_cm)


def _time_edge_stage(
    camera: Camera,
    method: Literal["canny", "directional", "colour"],
    frames: list[UInt8[np.ndarray, "h w 3"]],
    rounds: int,
) -> list[float]:
    """Return the times from the frame to points on the road, [ms], with one method running alone."""
    extractor = RoadEdgeExtractor(camera, PerceptionSettings(edges=EdgeSettings(method=method)))
    times_ms = []
    for i in range(_WARM_UP + rounds):
        begin = time.perf_counter()
        extractor.extract(frames[i % len(frames)])
        times_ms.append(1e3 * (time.perf_counter() - begin))
    return times_ms[_WARM_UP:]


def _detectors(camera: Camera, models: Sequence[Path], threads: int) -> dict[str, Detector]:
    networks: dict[str, Detector] = {
        f"network {model}": NetworkDetector(model, camera, any_camera=True, threads=threads)
        for model in models
    }
    inputs = DetectorInputs(camera=camera, lane_width_cm=LANE_WIDTH_CM)
    without_model = detector_names(lambda kind: not kind.needs_model)
    return networks | {name: build_detector(name, inputs) for name in without_model}


def plain_canny(frame: UInt8[np.ndarray, "h w 3"]) -> None:
    """Do what all times are compared with."""
    cv2.Canny(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), 40.0, 100.0, L2gradient=True)


class _Drive:
    """One detector with the controller and the limiter that follow it in the drive loop."""

    def __init__(self, detector: Detector, camera: Camera) -> None:
        steering = SteeringSettings(wheelbase_cm=camera.wheelbase_cm)
        self._detector = detector
        self._controller = LaneController(ControlSettings(steering=steering))
        self._limiter = CommandLimiter(LimitSettings())
        self._t_s = 0.0

    def step(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Go from a frame to a limited command."""
        estimate = self._detector.detect(frame)
        target = self._controller.target(estimate, self._t_s, 60.0, self._limiter.steering_rad)
        self._limiter.limit(target.steering_rad, 0.2, self._t_s)
        self._t_s += _PERIOD_S


class _Path:
    """What is done with every frame, and how long that took."""

    def __init__(self, step: Callable[[UInt8[np.ndarray, "h w 3"]], None]) -> None:
        self._step = step
        self.forget()

    def forget(self) -> None:
        """Drop the times so far."""
        self._wall_s: list[float] = []
        self._cpu_s: list[float] = []

    def run(self, frames: Sequence[UInt8[np.ndarray, "h w 3"]], count: int) -> None:
        for i in range(count):
            wall_s, cpu_s = time.perf_counter(), time.thread_time()
            self._step(frames[i % len(frames)])
            self._cpu_s.append(time.thread_time() - cpu_s)
            self._wall_s.append(time.perf_counter() - wall_s)

    def figures(self) -> dict[str, float]:
        times_ms = {"": 1e3 * np.array(self._wall_s), "cpu_": 1e3 * np.array(self._cpu_s)}
        percents = {"median": 50.0, "p99": 99.0}
        return {
            f"{clock}{name}_ms": float(np.percentile(values, percent))
            for clock, values in times_ms.items()
            for name, percent in percents.items()
        }
