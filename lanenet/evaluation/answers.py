"""Every detector over the same labelled frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.data.label_set import LabelSet
from lanenet.data.maps.labelled_frames import LabelledFrames
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.geometry.lane import N_POINTS, SIDES
from lanenet.perception.edges.road import RoadEdgeExtractor
from lanenet.perception.estimate import Detector
from lanenet.perception.hough.detector import HoughSettings, HoughTracker
from lanenet.perception.lane_filter.detector import LaneFilter, LaneFilterSettings
from lanenet.perception.registry import build_detector, filter_settings

ComparedName = Literal["network", "lane-filter", "hough", "hough-value", "painter"]
#: All that can be compared, in the order of the tables; what the others are held against comes first.
COMPARED: tuple[ComparedName, ...] = ("network", "lane-filter", "hough", "hough-value", "painter")
#: These look at edge points only, so that a label set, which has no frames, will do.
ON_LABEL_SETS: tuple[ComparedName, ...] = ("network", "lane-filter")

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class FrameAnswers:
    """What detectors said about the frames of a source, by their names.

    Attributes:
        points_cm: Six points per frame, frame car; NaN where a detector has no answer.
        sigma_cm: Standard deviation of each point; NaN where a detector does not know it.
        presence: Probability that the left and the right line can be seen; NaN likewise.
        confidence: By which the car slows down and stops.
        brightness: Mean grey level of each frame, 0 to 255.
    """

    points_cm: dict[str, Float[np.ndarray, "n 6"]]
    sigma_cm: dict[str, Float[np.ndarray, "n 6"]]
    presence: dict[str, Float[np.ndarray, "n 2"]]
    confidence: dict[str, Float[np.ndarray, "n"]]
    brightness: Float[np.ndarray, "n"]


def choose_names(text: str) -> tuple[ComparedName, ...]:
    """Read a list of detectors, as in ``network,painter``; they come back in the order of the tables.

    Raises:
        ConfigError: If a name is unknown, or there is none.
    """
    wanted = [part.strip() for part in text.split(",") if part.strip()]
    unknown = [name for name in wanted if name not in COMPARED]
    if unknown or not wanted:
        found = repr(unknown[0]) if unknown else "no detector"
        raise ConfigError(f"--detectors {text!r}: found {found}, known: {', '.join(COMPARED)}")
    return tuple(name for name in COMPARED if name in wanted)


def build_compared(
    names: Sequence[ComparedName],
    frames: LabelledFrames,
    *,
    model: Path | None = None,
    marking_cm: float | None = None,
    any_camera: bool = False,
) -> dict[str, Detector]:
    """Build detectors for the camera, the lane and the markings of a source.

    Args:
        names: Which ones.
        frames: Where they will be run.
        model: ONNX file, needed by ``network``.
        marking_cm: Thickness of the tape for ``lane-filter``; None takes the source's, or the default.
        any_camera: Accept a model that was trained with another camera.

    Raises:
        ConfigError: If something that a detector needs is missing or out of range.
        ModelMismatchError: If the model cannot be used with this camera.
        CalibrationError: If the camera sees no road.
    """
    detectors: dict[str, Detector] = {}
    for name in names:
        if name == "hough-value":
            # On most floors the paper's hue is noise, while the brightness shows the lines.
            brightness = HoughSettings.model_validate({"edges": {"channel": "value"}})
            detectors[name] = HoughTracker(frames.camera, brightness)
        elif name == "lane-filter":
            # The perception is the source's: it leaves out the rows in which a car sees itself.
            settings = filter_settings(frames.lane_width_cm, frames.marking_cm, marking_cm)
            detectors[name] = LaneFilter(RoadEdgeExtractor(frames.camera, frames.perception), settings)
        elif name == "network":
            # Beside the rows that the model leaves out, those in which this car sees itself.
            mask = hidden_rows(frames) if frames.perception.range.bottom_rows else None
            # It is told what the lane filter is told; so is the car.
            detectors[name] = build_detector(
                name,
                frames.camera,
                model=model,
                lane_width_cm=frames.lane_width_cm,
                any_camera=any_camera,
                mask=mask,
            )
        else:
            detectors[name] = build_detector(name, frames.camera)
    return detectors


def hidden_rows(frames: LabelledFrames) -> UInt8[np.ndarray, "h w"]:
    """Return a mask of the rows in which a source's car sees itself."""
    mask = np.zeros((frames.camera.height, frames.camera.width), np.uint8)
    mask[frames.camera.height - frames.perception.range.bottom_rows :] = 255
    return mask


def answer_frames(
    frames: LabelledFrames, detectors: Mapping[str, Detector], progress: Progress | None = None
) -> FrameAnswers:
    """Run detectors over every frame in order; all forget what they saw where the source is interrupted.

    Args:
        frames: The source; each image is read once.
        detectors: By name.
        progress: Called with (frames done, frames).

    Raises:
        DriveFormatError: If a frame cannot be read; names it.
        CalibrationError: If a frame does not fit the camera; names it.
    """
    n = len(frames)
    answers = FrameAnswers(
        {name: np.full((n, N_POINTS), np.nan) for name in detectors},
        {name: np.full((n, N_POINTS), np.nan) for name in detectors},
        {name: np.full((n, len(SIDES)), np.nan) for name in detectors},
        {name: np.full(n, np.nan) for name in detectors},
        np.empty(n),
    )
    for i in range(n):
        try:
            image = frames.image(i)
        except DriveFormatError as error:
            raise DriveFormatError(f"{frames.name}: {error}") from None
        # Every fourth pixel is enough for a mean.
        answers.brightness[i] = image[::4, ::4].mean()
        for name, detector in detectors.items():
            if i == 0 or frames.starts[i]:
                detector.reset()
            try:
                found = detector.detect(image)
            except CalibrationError as error:
                raise CalibrationError(f"{frames.name}, frame {frames.frames[i]}: {error}") from None
            answers.points_cm[name][i] = found.points_cm
            answers.sigma_cm[name][i] = found.sigma_cm
            answers.presence[name][i] = found.presence
            answers.confidence[name][i] = found.confidence
        if progress is not None:
            progress(i + 1, n)
    return answers


def lane_filter_points_cm(
    label_set: LabelSet, settings: LaneFilterSettings | None = None
) -> Float[np.ndarray, "n 6"]:
    """Run the lane filter over a label set.

    The filter starts again wherever a frame does not follow the one before it.

    Args:
        label_set: Frames with their edge points and the directions of these.
        settings: Of the filter; None takes its defaults with the label set's lane width.

    Returns:
        Six points per frame, [cm], frame car; NaN where the filter has no answer.
    """
    if settings is None:
        settings = LaneFilterSettings(lane_width_cm=label_set.meta.lane_width_cm)
    lane_filter = LaneFilter(None, settings)
    points = np.full(label_set.points_cm.shape, np.nan)
    for i, edges in enumerate(label_set.edges):
        follows = (
            i > 0
            and label_set.drive[i] == label_set.drive[i - 1]
            and label_set.frame[i] == label_set.frame[i - 1] + 1
        )
        if not follows:
            lane_filter.reset()
        edges = np.asarray(edges, np.float64)
        points[i] = lane_filter.estimate(edges[:, :2], edges[:, 2:]).points_cm
    return points
