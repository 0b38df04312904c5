"""Detectors by name, built for a camera; and the ones without a network run over label sets."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from lanenet.config import check_settings, load_settings
from lanenet.data.label_set import LabelSet
from lanenet.errors import CalibrationError, ConfigError
from lanenet.geometry.camera import Camera
from lanenet.perception.birdseye import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import Detector
from lanenet.perception.hough.tracker import HoughSettings, HoughTracker
from lanenet.perception.lane_filter import LaneFilter, LaneFilterSettings
from lanenet.perception.network import NetworkDetector
from lanenet.perception.painter.painter import LanePainter, PainterSettings

DetectorName = Literal["network", "lane-filter", "hough", "painter"]
#: These answer with lines of the image and a steering even without a camera.
WITHOUT_CAMERA = ("hough", "painter")


def build_detector(
    name: DetectorName,
    camera: Camera | None,
    *,
    model: Path | None = None,
    lane_width_cm: float | None = None,
    marking_cm: float | None = None,
    any_camera: bool = False,
    config: Path | None = None,
) -> Detector:
    """Build a detector for a camera.

    Args:
        name: Which one.
        camera: Camera of the frames; ``hough`` and ``painter`` do without, but then know no centimetres.
        model: ONNX file, needed by ``network``.
        lane_width_cm: Between the middles of the two lines, needed by ``lane-filter``.
        marking_cm: Thickness of the tape for ``lane-filter``; None takes its default.
        any_camera: Accept a model that was trained with another camera.
        config: YAML with the settings of ``hough`` or ``painter``; None takes the defaults.

    Raises:
        ConfigError: If something that the detector needs is missing or out of range.
        ModelMismatchError: If the model cannot be used with this camera.
        CalibrationError: If the camera sees no road.
    """
    if config is not None and name not in WITHOUT_CAMERA:
        raise ConfigError(f"detector {name}: takes no settings file, found {config}")
    if name == "hough":
        return HoughTracker(
            camera, HoughSettings() if config is None else load_settings(HoughSettings, config)
        )
    if name == "painter":
        painter = PainterSettings() if config is None else load_settings(PainterSettings, config)
        return LanePainter(camera, painter)
    if camera is None:
        raise CalibrationError(f"detector {name}: expected a camera (--camera camera.yaml)")
    if name == "network":
        if model is None:
            raise ConfigError("detector network: expected a model (--model MODEL.onnx)")
        return NetworkDetector(model, camera, any_camera=any_camera)
    if lane_width_cm is None:
        raise ConfigError(
            "detector lane-filter: the source comes without a lane width, expected one (--lane-width CM)"
        )
    extractor = RoadEdgeExtractor(camera, PerceptionSettings())
    return LaneFilter(extractor, filter_settings(lane_width_cm, marking_cm))


def filter_settings(lane_width_cm: float, marking_cm: float | None = None) -> LaneFilterSettings:
    """Return the lane filter's settings for a lane, with its default thickness of tape if none is given.

    Raises:
        ConfigError: If a value is out of range.
    """
    data = {"lane_width_cm": lane_width_cm} | ({} if marking_cm is None else {"marking_cm": marking_cm})
    return check_settings(LaneFilterSettings, data, "lane filter")


def lane_filter_points_cm(
    label_set: LabelSet, settings: LaneFilterSettings | None = None
) -> Float[np.ndarray, "n 6"]:
    """Run the lane filter over a label set.

    The filter starts again wherever a frame does not follow the one before it.

    Args:
        label_set: Frames with their edge points.
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
        points[i] = lane_filter.estimate(np.asarray(edges[:, :2], np.float64)).points_cm
    return points
