"""Run detectors over frames; for one detector: a table of detections and, on request, an annotated video."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.data.detections import DetectionTable, check_table_path
from lanenet.data.drives.motion import Motion, motion_of_commands
from lanenet.data.drives.sources import Source
from lanenet.data.files import atomic_file, check_destination
from lanenet.errors import CalibrationError, DriveFormatError, UnreadableFrameError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import lane_width_cm
from lanenet.perception.draw import draw_estimate
from lanenet.perception.estimate import Detector, LaneEstimate, TakesMotion
from lanenet.perception.image_lane import ImageLane

if TYPE_CHECKING:
    from lanenet.data.maps.mapped_drive import LabelledFrames


#: Annotated frames are enlarged to at least this width. Chosen: the text can be read.
VIDEO_WIDTH_PX = 640
#: Name of the detector where there is one only.
ONE = "it"
VIDEO_ENDINGS = (".mp4", ".m4v", ".mov")
#: Of what is written in place of a video where there is one frame.
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg")
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SeenFrame:
    """One frame and what detectors say about it.

    Attributes:
        index: Its position.
        image: None if it cannot be read.
        problem: Why it cannot be read.
        estimates: By detector; empty estimates for a frame that cannot be read.
        seconds: What each detector took; none for a frame that cannot be read.
    """

    index: int
    image: UInt8[np.ndarray, "h w *c"] | None
    problem: str | None
    estimates: Mapping[str, LaneEstimate]
    seconds: Mapping[str, float]


def run_detectors(
    frames: Source | LabelledFrames,
    detectors: Mapping[str, Detector],
    motion: Motion | None = None,
    *,
    skip_unreadable: bool = False,
) -> Iterator[SeenFrame]:
    """Run detectors over frames in order; each image is read once.

    The detectors are reset at the first frame and wherever the source is interrupted.

    Args:
        frames: The source.
        detectors: By name.
        motion: Motion of the car; told to the detectors that ask for it, as in the car's loop.
        skip_unreadable: Yield a frame that cannot be read with empty estimates.

    Raises:
        UnreadableFrameError: If a frame cannot be read; names it.
        CalibrationError: If a frame does not fit the camera; names it.
    """
    for i in range(len(frames)):
        if i == 0 or frames.starts[i]:
            for detector in detectors.values():
                detector.reset()
        elif motion is not None and np.isfinite(motion.turn_rad[i]):
            for detector in detectors.values():
                if isinstance(detector, TakesMotion):
                    detector.moved(float(motion.travel_cm[i]), float(motion.turn_rad[i]), motion.wheelbase_cm)
        try:
            image = frames.image(i)
        except DriveFormatError as error:
            if not skip_unreadable:
                raise UnreadableFrameError(f"{frames.name}: {error}") from None
            yield SeenFrame(i, None, str(error), dict.fromkeys(detectors, LaneEstimate()), {})
            continue
        estimates, seconds = {}, {}
        for name, detector in detectors.items():
            start_s = time.perf_counter()
            try:
                estimates[name] = detector.detect(image)
            except CalibrationError as error:
                raise CalibrationError(f"{frames.name}, frame {frames.frames[i]}: {error}") from None
            seconds[name] = time.perf_counter() - start_s
        yield SeenFrame(i, image, None, estimates, seconds)


@dataclass(frozen=True)
class DetectReport:
    """What a run did.

    Attributes:
        out: The table of detections.
        video: The annotated video, if wanted.
        frames: Rows of the table.
        complete: Frames with all six points.
        steered: Frames with a steering target.
        median_ms: Median time of the detector per frame.
        p99_ms: 99th percentile of it.
        problems: A line for each frame that could not be read; its row is empty.
        width_cm: Width of the lane in the answers with all six points, the median; NaN without one.
    """

    out: Path
    video: Path | None
    frames: int
    complete: int
    steered: int
    median_ms: float
    p99_ms: float
    problems: tuple[str, ...]
    width_cm: float = math.nan


def run_detector(
    source: Source,
    detector: Detector,
    camera: Camera | None,
    out: Path,
    video: Path | None = None,
    progress: Progress | None = None,
    *,
    skip_unreadable: bool = False,
    watch: Callable[[SeenFrame], None] | None = None,
) -> DetectReport:
    """Run a detector over every frame of a source and write what it finds.

    Files are moved into place when they are complete. The detector is reset where the source is interrupted.

    Args:
        source: The frames.
        detector: Any detector.
        camera: Camera of the frames, for drawing; None for a detector without one.
        out: Table of detections, ``.parquet`` or ``.csv``.
        video: Annotated video (mp4v), or None; of one frame a picture, if its ending is that of one.
        progress: Called with (frames done, frames).
        skip_unreadable: Give a frame that cannot be read an empty row and name it in the report.
        watch: Called with each frame and, under :data:`ONE`, the detector's answer.

    Returns:
        Counts, timings and problems.

    Raises:
        DriveFormatError: If a frame cannot be read; with ``skip_unreadable``, if none can.
        CalibrationError: If a frame does not fit the camera; the message names it.
        LabelFormatError: If the ending of ``out`` is unknown.
        LanenetError: If ``out`` or ``video`` cannot be written there; found before the first frame.
    """
    # Before the work, which may take an hour.
    check_table_path(out)
    if video is not None:
        _check_video(video, len(source))
        check_destination(video)
    table = DetectionTable()
    times_s: list[float] = []
    problems: list[str] = []
    widths_cm: list[float] = []
    complete = steered = 0
    motion = None
    if camera is not None and source.commands is not None:
        motion = motion_of_commands(source.commands, source.t_s, source.starts, camera.wheelbase_cm)
    running = run_detectors(source, {ONE: detector}, motion, skip_unreadable=skip_unreadable)
    with ExitStack() as stack:
        writer = _AnnotatedVideo(stack, video, camera, source.rate_hz) if video is not None else None
        for seen in running:
            i, estimate = seen.index, seen.estimates[ONE]
            times_s += seen.seconds.values()
            if seen.problem is not None:
                problems.append(seen.problem)
            if estimate.mask.all():
                complete += 1
                widths_cm.append(lane_width_cm(estimate.points_cm))
            steered += bool(np.isfinite(estimate.steering_rad))
            table.add(int(source.frames[i]), float(source.t_s[i]), estimate)
            if writer is not None:
                took = f", detector {1e3 * np.median(times_s[-100:]):.1f} ms" if times_s else ""
                lane = getattr(detector, "last", None) if seen.image is not None else None
                writer.add(seen.image, estimate, f"frame {source.frames[i]}{took}", lane)
            if watch is not None:
                watch(seen)
            if progress is not None:
                progress(i + 1, len(source))
        if not times_s:
            raise DriveFormatError(
                f"{source.name}: none of its {len(source)} frames can be read; the first: {problems[0]}"
            )
        table.write(out)
    median_ms, p99_ms = (1e3 * float(np.percentile(times_s, q)) for q in (50, 99))
    problems = [*source.problems, *problems]
    width_cm = float(np.nanmedian(widths_cm)) if np.isfinite(widths_cm).any() else math.nan
    return DetectReport(
        out, video, len(source), complete, steered, median_ms, p99_ms, tuple(problems), width_cm
    )


def _check_video(video: Path, frames: int) -> None:
    if video.suffix.lower() not in (*VIDEO_ENDINGS, *(PICTURE_ENDINGS if frames == 1 else ())):
        raise DriveFormatError(
            f"{video}: a video ends in one of {', '.join(VIDEO_ENDINGS)}, and the picture of a single photo "
            f"in one of {', '.join(PICTURE_ENDINGS)}"
        )


class _OnePicture:
    """Writes one frame as a picture, where OpenCV's writer of videos would write several."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, drawn: UInt8[np.ndarray, "h w 3"]) -> None:
        if not cv2.imwrite(str(self._path), drawn):
            raise DriveFormatError(f"{self._path}: OpenCV cannot write it")

    def release(self) -> None:
        """Nothing is held."""


class _AnnotatedVideo:
    """Writes annotated frames to a temporary name; the stack moves the file into place or removes it."""

    def __init__(self, stack: ExitStack, path: Path, camera: Camera | None, rate_hz: float) -> None:
        self.path, self.camera, self.rate_hz = path, camera, rate_hz
        self._temporary = stack.enter_context(atomic_file(path))
        self._writer: Any = None
        #: Width and height of the frames; without a camera those of the first that can be read.
        self._size: tuple[int, int] | None = None
        #: Captions of the unreadable frames before that one.
        self._waiting: list[str] = []
        # Released before the file is moved: the stack undoes in reverse.
        stack.callback(self._release)
        if camera is not None:
            self._open(camera.width, camera.height)

    def _open(self, width: int, height: int) -> None:
        self._size = (width, height)
        self.scale = max(1, -(-VIDEO_WIDTH_PX // width))
        size = (width * self.scale, height * self.scale)
        if self.path.suffix.lower() in PICTURE_ENDINGS:
            self._writer = _OnePicture(self._temporary)
            return
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._temporary), codec, self.rate_hz, size)
        if not self._writer.isOpened():
            raise DriveFormatError(f"{self.path}: OpenCV cannot write mp4v video of {size[0]}x{size[1]} here")

    def _release(self) -> None:
        if self._writer is not None:
            self._writer.release()

    def add(
        self,
        frame_bgr: UInt8[np.ndarray, "h w *c"] | None,
        estimate: LaneEstimate,
        caption: str,
        image_lane: ImageLane | None = None,
    ) -> None:
        if frame_bgr is None:
            caption += "  unreadable"
            if self._size is None:
                self._waiting.append(caption)
                return
            # A black frame keeps the video in step with the table.
            frame_bgr = np.zeros((self._size[1], self._size[0], 3), np.uint8)
        if self._size is None:
            self._open(frame_bgr.shape[1], frame_bgr.shape[0])
            for text in self._waiting:
                self._write(np.zeros_like(frame_bgr), LaneEstimate(), text, None)
        self._write(frame_bgr, estimate, caption, image_lane)

    def _write(
        self,
        frame_bgr: UInt8[np.ndarray, "h w *c"],
        estimate: LaneEstimate,
        caption: str,
        image_lane: ImageLane | None,
    ) -> None:
        assert self._size is not None
        drawn = draw_estimate(frame_bgr, estimate, self.camera, self.scale, caption, image_lane)
        size = (self._size[0] * self.scale, self._size[1] * self.scale)
        if (drawn.shape[1], drawn.shape[0]) != size:
            # Photos of a folder may differ in size.
            drawn = np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA))
        self._writer.write(drawn)
