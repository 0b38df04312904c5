"""Every detector over the same labelled frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.data.label_set import LabelSet
from lanenet.data.maps.labelled_frames import LabelledFrames
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.geometry.lane import N_POINTS, SIDES
from lanenet.perception.detector_kind import DetectorInputs, EdgeDetector
from lanenet.perception.estimate import Detector
from lanenet.perception.registry import build_detector, compared_names, kind_of

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


def choose_names(text: str) -> tuple[str, ...]:
    """Read a list of detectors, as in ``network,painter``; they come back in the order of the tables.

    Raises:
        ConfigError: If a name is unknown, or there is none.
    """
    known = compared_names()
    wanted = [part.strip() for part in text.split(",") if part.strip()]
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        found = repr(unknown[0]) if unknown else "no detector"
        raise ConfigError(f"--detectors {text!r}: found {found}, known: {', '.join(known)}")
    return tuple(name for name in known if name in wanted)


def build_compared(
    names: Sequence[str],
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
    inputs = DetectorInputs(
        camera=frames.camera,
        model=model,
        any_camera=any_camera,
        # The network gets the same lane width as the lane filter, as on the car.
        lane_width_cm=frames.lane_width_cm,
        marking_cm=frames.marking_cm if marking_cm is None else marking_cm,
        perception=frames.perception,
    )
    # Beside the rows that a model leaves out, those in which this car sees itself.
    hidden = hidden_rows(frames) if frames.perception.range.bottom_rows else None
    return {
        name: build_detector(name, replace(inputs, mask=hidden if kind_of(name).takes_mask else None))
        for name in names
    }


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


def answer_edges(label_set: LabelSet, detector: EdgeDetector) -> Float[np.ndarray, "n 6"]:
    """Run a detector over the edge points of a label set.

    The detector is reset wherever a frame does not follow the one before it.

    Args:
        label_set: Frames with their edge points and the directions of these.
        detector: Built for the label set's lane.

    Returns:
        Six points per frame, [cm], frame car; NaN where the detector has no answer.
    """
    points = np.full(label_set.points_cm.shape, np.nan)
    for i, edges in enumerate(label_set.edges):
        follows = (
            i > 0
            and label_set.drive[i] == label_set.drive[i - 1]
            and label_set.frame[i] == label_set.frame[i - 1] + 1
        )
        if not follows:
            detector.reset()
        edges = np.asarray(edges, np.float64)
        points[i] = detector.estimate(edges[:, :2], edges[:, 2:]).points_cm
    return points
