"""What a label set's file says of all its rows: window, camera, lane, and how its edges were found."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from pydantic import Field

from lanenet.config import Settings, check_settings
from lanenet.errors import ConfigError, LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM
from lanenet.perception.birdseye import PerceptionSettings

FORMAT = "lanenet-labels/1"
Source = Literal["map", "truth"]

_UNITS = {"_cm": "centimetre", "_rad": "radian", "_s": "second", "quality": "0 to 1"}


class _WindowFile(Settings):
    left_cm: float
    near_cm: float
    cell_cm: float = Field(gt=0.0)
    rows: int = Field(gt=0)
    columns: int = Field(gt=0)


class _MetaFile(Settings):
    format: Literal["lanenet-labels/1"]
    rows_cm: tuple[float, ...]
    order: tuple[str, ...]
    units: dict[str, str]
    window: _WindowFile
    camera_hash: str
    wheelbase_cm: float = Field(gt=0.0)
    lane_width_cm: float = Field(gt=0.0)
    source: Source
    perception: PerceptionSettings
    marking_cm: float | None = Field(default=None, gt=0.0)
    config_hash: str = ""
    camera_cm: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class LabelMeta:
    """What all rows of a label set share.

    Attributes:
        window: Patch of road that the bird's-eye pictures show.
        camera_hash: Camera that the edge points came through.
        wheelbase_cm: Distance between the car's axles; moves poses to the front axle.
        lane_width_cm: Distance between the middles of the two lines.
        source: ``map`` for labels from a map made of the drive, ``truth`` for a simulator's.
        perception: How the edge points were found; the car has to find them the same way.
        marking_cm: Width of the markings; None if unknown.
        config_hash: Hash of the settings that made the labels; empty if unknown.
        camera_cm: Optical centre right of, ahead of and above the front axle; None if unknown.
    """

    window: BirdseyeWindow
    camera_hash: str
    wheelbase_cm: float
    lane_width_cm: float
    source: Source
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    marking_cm: float | None = None
    config_hash: str = ""
    camera_cm: tuple[float, float, float] | None = None


def meta_to_file(meta: LabelMeta, where: str) -> dict[str, Any]:
    """Return what the file will say, as plain values.

    Raises:
        LabelFormatError: If :func:`meta_from_file` would refuse it; ``where`` names the file.
    """
    data = {
        "format": FORMAT,
        "rows_cm": list(ROWS_CM),
        "order": list(POINT_NAMES),
        "units": _UNITS,
        **asdict(meta),
        "perception": meta.perception.model_dump(mode="json"),
    }
    meta_from_file(data, where)
    return data


def meta_from_file(data: dict[str, Any], where: str) -> LabelMeta:
    """Read what a file says of its rows.

    Raises:
        LabelFormatError: If it is of another kind or version, made for other label rows, or a key is wrong;
            ``where`` names the file.
    """
    found = data.get("format")
    if found != FORMAT:
        raise LabelFormatError(f"{where}: expected format {FORMAT!r}, found {found!r}")
    try:
        file = check_settings(_MetaFile, data, f"{where}: metadata")
    except ConfigError as error:
        raise LabelFormatError(str(error)) from None
    if file.rows_cm != ROWS_CM or file.order != POINT_NAMES:
        raise LabelFormatError(
            f"{where}: expected labels at rows {ROWS_CM} in the order {', '.join(POINT_NAMES)}; found rows "
            f"{file.rows_cm} in the order {', '.join(file.order)}"
        )
    return LabelMeta(
        window=BirdseyeWindow(**file.window.model_dump()),
        camera_hash=file.camera_hash,
        wheelbase_cm=file.wheelbase_cm,
        lane_width_cm=file.lane_width_cm,
        source=file.source,
        perception=file.perception,
        marking_cm=file.marking_cm,
        config_hash=file.config_hash,
        camera_cm=file.camera_cm,
    )
