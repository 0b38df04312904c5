"""Localise a car as it drives: poses are written as frames come, a map is drawn, memory stays bounded."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.localise.live_filter import LiveFrame, LiveLocaliser, LivePose, StartSettings
from datagen.quality.pictures import draw_metre, write_png
from datagen.settings import MapSettings
from lanenet.data.files import atomic_file, check_destination
from lanenet.data.tables import TUM_HEADER, tum_lines
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car

HEADER = "frame,t_s,x_cm,y_cm,heading_rad,segment,match,spread_cm\n"
#: Frames whose times are kept: enough for a 99th percentile.
_TIMED = 2000
#: Edges further away than this, in camera heights, would blur the picture.
_DRAWN_HEIGHTS = 3.0
#: Side of a pixel of the picture at first, [cm]: a quarter of a narrow tape; empty rim of the picture.
_FINEST_CM, _MARGIN_PX = 0.5, 40
#: Colours of the picture: number of hues, frames that share one, and the value of the driven path.
_HUES, _FRAMES_PER_HUE, _DRIVEN = 150, 4, 255
#: Width and height of the canvas: 12 m at the finest, in 5.8 MB.
_CANVAS_PX = 2400


@dataclass(frozen=True)
class LiveReport:
    """What a run did.

    Attributes:
        out: Poses as CSV.
        trajectory: The same as a TUM file.
        picture: The longest segment from above.
        frames: Frames taken in.
        poses: Poses written.
        segments: Segments that gave poses.
        localiser: With its map, the steering that it found, and how many frames it left out.
        factor: Typical distance factor (see :class:`datagen.slam.filter.motion.MotionModel`).
        speed_known: Whether the factor is the gain of a recorded speed, not a step length in cm.
        match: Median matched share of a frame's edges.
        median_ms: Median time per frame of edges and filter together, over the last frames; NaN if all poses
            were found at once, at the end.
        p99_ms: Its 99th percentile.
        process_mb: Peak memory of the process; None where the system does not tell.
    """

    out: Path
    trajectory: Path
    picture: Path
    frames: int
    poses: int
    segments: int
    localiser: LiveLocaliser
    factor: float
    speed_known: bool
    match: float
    median_ms: float
    p99_ms: float
    process_mb: float | None


def localise(
    frames: Iterable[LiveFrame],
    camera: Camera,
    settings: MapSettings,
    out: Path,
    start: StartSettings | None = None,
    progress: Callable[[int], None] | None = None,
) -> LiveReport:
    """Localise a car frame by frame with the particle filter alone.

    Each pose is on disk when its frame has been seen. Ctrl-C ends the drive, not the program.

    Args:
        frames: Frames as they come: a recording (:func:`datagen.localise.live_filter.live_frames`) or a
            camera.
        camera: Camera of the frames.
        settings: Settings of perception, filter and motion.
        out: CSV to write; the trajectory (``.tum``) and the picture (``.png``) get its name.
        start: What is known of the car; None finds it.
        progress: Called with the number of frames taken in.

    Raises:
        TrackingLostError: If no segment was long enough to find the typical step in.
        DriveFormatError: If time goes back.
        CalibrationError: If the images are not of the camera's size.
        LanenetError: If a file cannot be written.
    """
    localiser = LiveLocaliser(camera, settings, StartSettings() if start is None else start)
    trajectory, picture = out.with_suffix(".tum"), out.with_suffix(".png")
    for path in (out, trajectory, picture):
        check_destination(path)
    # The picture shows the longest segment: that one and the one being driven are kept.
    longest = drawn = LiveCanvas()
    segment = taken = count = 0
    times_s: deque[float] = deque(maxlen=_TIMED)
    matches: deque[float] = deque(maxlen=_TIMED)
    segments, speed_known = set[int](), False
    reach_cm = _DRAWN_HEIGHTS * camera.mounting.height_cm
    with atomic_file(trajectory) as temporary, temporary.open("w", encoding="utf-8") as tum:
        tum.write(TUM_HEADER)

        def keep(poses: list[LivePose]) -> None:
            nonlocal longest, drawn, segment, count
            for pose in poses:
                known = pose.estimate
                _log(out, pose, first=count == 0)
                count += 1
                tum.writelines(tum_lines(np.array([pose.t_s]), known.pose[None]))
                if pose.segment != segment:
                    segment, drawn = pose.segment, LiveCanvas()
                near = pose.points_cm[np.hypot(*pose.points_cm.T) < reach_cm]
                drawn.add(map_from_car(near, known.pose, camera.wheelbase_cm), known.pose[:2])
                longest = drawn if drawn.frames > longest.frames else longest
                segments.add(segment)
                if np.isfinite(known.match):
                    matches.append(known.match)

        try:
            for frame in frames:
                begun_s = time.perf_counter()
                poses = localiser.take(frame)
                if len(poses) == 1:
                    # The burst at the start is not what a frame costs.
                    times_s.append(time.perf_counter() - begun_s)
                keep(poses)
                taken += 1
                speed_known = frame.commands.speed_cm_s is not None
                if progress is not None:
                    progress(taken)
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
        out=out,
        trajectory=trajectory,
        picture=picture,
        frames=taken,
        poses=count,
        segments=len(segments),
        localiser=localiser,
        factor=localiser.factor,
        speed_known=speed_known,
        match=float(np.median(matches)) if matches else float("nan"),
        median_ms=median_ms,
        p99_ms=p99_ms,
        process_mb=process_mb(),
    )


def _log(out: Path, pose: LivePose, first: bool) -> None:
    """Add a pose to a CSV that is complete at any moment; it begins with the first pose."""
    x, y, heading = pose.estimate.pose
    match = "" if np.isnan(pose.estimate.match) else f"{pose.estimate.match:.3f}"
    row = f"{pose.frame},{pose.t_s:.6f},{x:.4f},{y:.4f},{heading:.6f},{pose.segment},{match}"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("w" if first else "a", encoding="utf-8", newline="\n") as file:
            file.write((HEADER if first else "") + f"{row},{pose.estimate.spread_cm:.3f}\n")
    except OSError as error:
        raise LanenetError(f"{out}: cannot be written ({error})") from None


def process_mb() -> float | None:
    """Peak memory of this process so far; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    # In bytes on macOS, in KiB on Linux.
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024.0 / 1e6


class LiveCanvas:
    """A map from above of one segment: edges (hue = time, repeating) and the driven path (white).

    Where the car leaves the canvas, its pixels become twice as coarse, so that its memory does not grow.

    Attributes:
        frames: How many frames were drawn.
        cm_per_px: Side of a pixel.
    """

    def __init__(self, size_px: int = _CANVAS_PX) -> None:
        self.frames, self.cm_per_px = 0, _FINEST_CM
        self._pixels: UInt8[np.ndarray, "s s"] = np.zeros((size_px, size_px), np.uint8)
        #: Corners of what was drawn, and the canvas's own lower one, frame map.
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        self._corner = np.zeros(2)
        self._car: Float[np.ndarray, "1 2"] | None = None

    def add(self, edges_map_cm: Float[np.ndarray, "m 2"], car_cm: Float[np.ndarray, "2"]) -> None:
        """Draw a frame's edges and the path to its pose, [cm], frame map."""
        before = car_cm[None] if self._car is None else self._car
        self._car = car_cm[None]
        steps = int(np.abs(self._car - before).max() / self.cm_per_px) + 2
        path = before + np.linspace(0.0, 1.0, steps)[:, None] * (self._car - before)
        self._make_room(np.concatenate([edges_map_cm, path]))
        self._plot(edges_map_cm, 1 + self.frames // _FRAMES_PER_HUE % _HUES)
        self._plot(path, _DRIVEN)
        self.frames += 1

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return what was drawn, with a scale bar of a metre."""
        colours = np.full((256, 1, 3), 24, np.uint8)
        hues = np.stack([np.arange(_HUES), np.full(_HUES, 200), np.full(_HUES, 200)], axis=1)
        colours[1 : 1 + _HUES] = cv2.cvtColor(hues[:, None].astype(np.uint8), cv2.COLOR_HSV2BGR)
        colours[_DRIVEN] = 255
        used = self._pixels
        if self.frames:
            low, high = (((c - self._corner) / self.cm_per_px).astype(int) for c in (self._low, self._high))
            used = used[low[1] : high[1] + 1, low[0] : high[0] + 1]
        # y grows upwards on the map.
        indices = np.pad(used[::-1], _MARGIN_PX)
        image = np.ascontiguousarray(colours[indices, 0])
        draw_metre(image, 1.0 / self.cm_per_px)
        return image

    def _plot(self, points_cm: Float[np.ndarray, "m 2"], value: int) -> None:
        column, row = ((points_cm - self._corner) / self.cm_per_px).astype(int).T
        self._pixels[row, column] = np.maximum(self._pixels[row, column], value) if value < 255 else value

    def _make_room(self, points_cm: Float[np.ndarray, "m 2"]) -> None:
        """Move or coarsen the canvas so that the points fit on it."""
        self._low = np.minimum(self._low, points_cm.min(axis=0))
        self._high = np.maximum(self._high, points_cm.max(axis=0))
        size = len(self._pixels)
        extent = self._high - self._corner
        if self.frames and (self._low >= self._corner).all() and (extent < size * self.cm_per_px).all():
            return
        row, column = np.nonzero(self._pixels)
        drawn = self._corner + (np.stack([column, row], axis=1) + 0.5) * self.cm_per_px
        values = self._pixels[row, column]
        # With room on all sides, so that this is rare.
        while 1.25 * (self._high - self._low).max() >= size * self.cm_per_px:
            self.cm_per_px *= 2.0
        self._corner = 0.5 * (self._low + self._high - size * self.cm_per_px)
        self._pixels[:] = 0
        column, row = ((drawn - self._corner) / self.cm_per_px).astype(int).T
        np.maximum.at(self._pixels, (row, column), values)
