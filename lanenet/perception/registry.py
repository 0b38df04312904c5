"""Detectors by name, built for a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Settings, check_settings, load_settings
from lanenet.errors import CalibrationError, ConfigError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import Detector
from lanenet.perception.hough.detector import HoughSettings, HoughTracker
from lanenet.perception.lane_filter.detector import LaneFilter, LaneFilterSettings
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.painter.detector import LanePainter, PainterSettings

DetectorName = Literal["network", "lane-filter", "hough", "painter"]
#: These answer with lines of the image and a steering even without a camera.
WITHOUT_CAMERA = ("hough", "painter")


class LaneFilterFile(Settings):
    """Settings file of ``lane-filter``: what differs from the defaults.

    Attributes:
        filter: Of :class:`LaneFilterSettings`; the lane width may be left out where the drive or the command
            line tells it.
        perception: How edge points are found in the frames.
    """

    filter: dict[str, Any] = Field(default_factory=dict)
    perception: PerceptionSettings = PerceptionSettings()


def build_detector(
    name: DetectorName,
    camera: Camera | None,
    *,
    model: Path | None = None,
    lane_width_cm: float | None = None,
    drive_lane_width_cm: float | None = None,
    marking_cm: float | None = None,
    any_camera: bool = False,
    config: Path | None = None,
    mask: UInt8[np.ndarray, "h w"] | None = None,
) -> Detector:
    """Build a detector for a camera.

    Args:
        name: Which one.
        camera: Camera of the frames; ``hough`` and ``painter`` do without, but then know no centimetres.
        model: ONNX file or checkpoint folder, needed by ``network``.
        lane_width_cm: Between the middles of the two lines, for ``lane-filter``, where it goes before the
            file's, and for ``network``, which rebuilds a missing line with it.
        drive_lane_width_cm: What the source says about that; counts where neither it nor the file does.
        marking_cm: Thickness of the tape for ``lane-filter``; goes before the file's.
        any_camera: Accept a model that was trained with another camera.
        config: YAML with settings: :class:`LaneFilterFile`, :class:`HoughSettings` or
            :class:`PainterSettings`; None takes the defaults.
        mask: Nonzero on the car itself; ``lane-filter`` and ``network`` leave out what they see there.

    Raises:
        ConfigError: If something that the detector needs is missing or out of range, or it cannot use what
            is given.
        ModelMismatchError: If the model cannot be used with this camera.
        CalibrationError: If the camera sees no road, or the mask is of another size.
    """
    if config is not None and name == "network":
        raise ConfigError(f"detector network: takes no settings file, its model holds them; found {config}")
    if mask is not None:
        refuse_mask(name)
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
            raise ConfigError("detector network: expected a model (--model MODEL)")
        width_cm = drive_lane_width_cm if lane_width_cm is None else lane_width_cm
        return NetworkDetector(model, camera, any_camera=any_camera, mask=mask, lane_width_cm=width_cm)
    settings, perception = lane_filter_settings(config, lane_width_cm, drive_lane_width_cm, marking_cm)
    return LaneFilter(RoadEdgeExtractor(camera, perception, mask), settings)


def refuse_mask(name: DetectorName) -> None:
    """Refuse a mask for a detector that cannot use one.

    Raises:
        ConfigError: If it looks at whole frames.
    """
    if name in WITHOUT_CAMERA:
        raise ConfigError(f"detector {name}: takes no mask (--mask); lane-filter and network do")


def lane_filter_settings(
    config: Path | None,
    lane_width_cm: float | None = None,
    drive_lane_width_cm: float | None = None,
    marking_cm: float | None = None,
) -> tuple[LaneFilterSettings, PerceptionSettings]:
    """Read the lane filter's settings file and put what is given in so many words above it.

    Args:
        config: YAML of :class:`LaneFilterFile`; None takes the defaults.
        lane_width_cm: As for :func:`build_detector`.
        drive_lane_width_cm: As for :func:`build_detector`.
        marking_cm: As for :func:`build_detector`.

    Raises:
        ConfigError: If nothing tells the lane width, or a value is unknown or out of range.
    """
    file = LaneFilterFile() if config is None else load_settings(LaneFilterFile, config)
    drive = {"lane_width_cm": drive_lane_width_cm}
    given = {"lane_width_cm": lane_width_cm, "marking_cm": marking_cm}
    data = {
        **{key: value for key, value in drive.items() if value is not None},
        **file.filter,
        **{key: value for key, value in given.items() if value is not None},
    }
    if "lane_width_cm" not in data:
        where = "neither the source nor a settings file tells" if config is None else f"{config} lacks"
        raise ConfigError(f"detector lane-filter: {where} the lane width, expected one (--lane-width CM)")
    where = "lane filter" if config is None else f"{config}: filter"
    return check_settings(LaneFilterSettings, data, where), file.perception


def filter_settings(
    lane_width_cm: float, source_marking_cm: float | None = None, marking_cm: float | None = None
) -> LaneFilterSettings:
    """Return the lane filter's settings for a source of labelled frames or edge points.

    Args:
        lane_width_cm: Of the source.
        source_marking_cm: Thickness of the tape that the source tells, if it does.
        marking_cm: Thickness that is given in so many words, which goes before the source's; the filter's
            default where there is neither.

    Raises:
        ConfigError: If a value is out of range.
    """
    thickness_cm = source_marking_cm if marking_cm is None else marking_cm
    return lane_filter_settings(None, lane_width_cm, marking_cm=thickness_cm)[0]
