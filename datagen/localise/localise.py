"""Localise a car as it drives: poses are written while frames come, a map is drawn, memory stays bounded."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from datagen.localise.live_filter import LiveLocaliser, LivePose, Moment, StartSettings
from datagen.localise.picture import LiveCanvas
from datagen.quality.pictures import write_png
from datagen.settings import MapSettings
from datagen.slam.commands import SteeringFit
from lanenet.data.files import atomic_file, check_destination
from lanenet.data.trajectory import TUM_HEADER, tum_lines
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car

HEADER = "frame,t_s,x_cm,y_cm,heading_rad,segment,match,spread_cm\n"
_TIMED = 2000  # frames of which the times are kept
_DRAWN_HEIGHTS = 3.0  # edges further away blur the picture


@dataclass(frozen=True)
class LiveReport:
    """What a run did.

    Attributes:
        out: Poses as CSV.
        trajectory: The same as a TUM file.
        picture: The longest segment from above.
        frames: Frames taken in.
        poses: Poses written.
        segments: Stretches without an interruption that gave poses.
        unreadable: Frames without an image.
        standing: Frames in which the car stood.
        dropped: Frames of stretches too short to find a speed in.
        factor: Usual distance factor (see :class:`datagen.slam.filter.motion.MotionModel`).
        speed_known: Whether the factor is the gain of a recorded speed, and not a way per frame in cm.
        steering: How the car answered to the steering; None where that was not found.
        match: Median matched share of a frame's edges.
        median_ms: Median time of edges and filter together per frame, over the last frames.
        p99_ms: 99th percentile of it.
        map_mb: Memory of the filter's map.
        process_mb: Most memory that the process has taken; None where the system does not tell.
    """

    out: Path
    trajectory: Path
    picture: Path
    frames: int
    poses: int
    segments: int
    unreadable: int
    standing: int
    dropped: int
    factor: float
    speed_known: bool
    steering: SteeringFit | None
    match: float
    median_ms: float
    p99_ms: float
    map_mb: float
    process_mb: float | None


def localise(
    moments: Iterable[Moment],
    camera: Camera,
    settings: MapSettings,
    out: Path,
    start: StartSettings | None = None,
    progress: Callable[[int], None] | None = None,
) -> LiveReport:
    """Localise a car frame by frame with the particle filter alone.

    Each pose is on disk when its frame has been seen. Ctrl-C ends the drive, and not the program.

    Args:
        moments: Frames as they come: a recording (:func:`datagen.localise.live_filter.moments_of`) or a
            camera.
        camera: Camera of the frames.
        settings: Settings of perception, filter and motion.
        out: CSV to write; the trajectory (``.tum``) and the picture (``.png``) get its name.
        start: What is known of the car; None finds it.
        progress: Called with the number of frames taken in.

    Raises:
        TrackingLostError: If no stretch of the drive was long enough to find the speed in.
        DriveFormatError: If time goes back.
        CalibrationError: If the images are not of the camera's size.
        LanenetError: If a file cannot be written.
    """
    localiser = LiveLocaliser(camera, settings, StartSettings() if start is None else start)
    trajectory, picture = out.with_suffix(".tum"), out.with_suffix(".png")
    for path in (out, trajectory, picture):
        check_destination(path)
    # The picture shows the longest segment: that one, and the one being driven, are kept.
    longest = drawn = LiveCanvas()
    segment = frames = count = 0
    times_s: deque[float] = deque(maxlen=_TIMED)
    matches: deque[float] = deque(maxlen=_TIMED)
    segments, speed_known = set[int](), False
    reach_cm = _DRAWN_HEIGHTS * camera.mounting.height_cm
    with ExitStack() as stack:
        log = stack.enter_context(_PoseLog(out))
        tum = stack.enter_context(stack.enter_context(atomic_file(trajectory)).open("w", encoding="utf-8"))
        tum.write(TUM_HEADER)

        def keep(poses: list[LivePose]) -> None:
            nonlocal longest, drawn, segment, count
            for pose in poses:
                known = pose.estimate
                log.add(pose)
                tum.writelines(tum_lines(np.array([pose.t_s]), known.pose[None]))
                if pose.segment != segment:
                    segment, drawn = pose.segment, LiveCanvas()
                near = pose.points_cm[np.hypot(*pose.points_cm.T) < reach_cm]
                drawn.add(map_from_car(near, known.pose, camera.wheelbase_cm), known.pose[:2])
                longest = drawn if drawn.frames > longest.frames else longest
                segments.add(segment)
                if np.isfinite(known.match):
                    matches.append(known.match)
            count += len(poses)

        try:
            for moment in moments:
                begun_s = time.perf_counter()
                poses = localiser.take(moment)
                if len(poses) == 1:
                    # A burst at the start is not what a frame costs.
                    times_s.append(time.perf_counter() - begun_s)
                keep(poses)
                frames += 1
                speed_known = moment.commands.speed_cm_s is not None
                if progress is not None:
                    progress(frames)
        except KeyboardInterrupt:
            pass
        keep(localiser.finish())
        localiser.check_found()
    write_png(picture, longest.picture())
    assert localiser.factor is not None
    median_ms, p99_ms = (
        (1e3 * float(np.percentile(times_s, q)) for q in (50, 99)) if times_s else (float("nan"),) * 2
    )
    return LiveReport(
        out,
        trajectory,
        picture,
        frames,
        count,
        len(segments),
        localiser.unreadable,
        localiser.standing,
        localiser.dropped,
        localiser.factor,
        speed_known,
        localiser.steering,
        float(np.median(matches)) if matches else float("nan"),
        median_ms,
        p99_ms,
        localiser.map_bytes / 1e6,
        process_mb(),
    )


class _PoseLog:
    """A CSV that is complete up to the last pose at any moment; it begins with the first pose."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: TextIO | None = None

    def __enter__(self) -> _PoseLog:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, pose: LivePose) -> None:
        x, y, heading = pose.estimate.pose
        match = "" if np.isnan(pose.estimate.match) else f"{pose.estimate.match:.3f}"
        self._write(
            f"{pose.frame},{pose.t_s:.6f},{x:.4f},{y:.4f},{heading:.6f},{pose.segment},{match},"
            f"{pose.estimate.spread_cm:.3f}\n"
        )

    def _write(self, text: str) -> None:
        try:
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self.path.open("w", encoding="utf-8", newline="\n")
                self._file.write(HEADER)
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            raise LanenetError(f"{self.path}: cannot be written ({error})") from None


def process_mb() -> float | None:
    """Most memory that this process has taken so far; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    # In bytes on macOS, in KiB on Linux.
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024.0 / 1e6
