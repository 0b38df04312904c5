"""Label sets: what the network learns from, a Parquet file with a row per frame.

A row holds the six labels, the edge points and the lane lines in the car frame. From points and lines,
augmented views get exact labels. The bird's-eye image is for people and other tools; training makes it from
the edge points again. Metadata hold what all rows share.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field

from lanenet.config import Settings, check_settings
from lanenet.data.camera_file import CameraFile, camera_data
from lanenet.data.files import require
from lanenet.data.tables import (
    MAX_PLACE,
    ParquetTable,
    float_array,
    list_array,
    png_bytes,
    read_footer,
    write_parquet,
)
from lanenet.errors import CalibrationError, ConfigError, LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow, WindowFile
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, POINT_NAMES, ROWS_CM, label_rows, rows_of_polyline
from lanenet.image_header import image_size
from lanenet.perception.edges.raster import fill_raster, new_raster
from lanenet.perception.edges.road import PerceptionSettings, RoadEdges
from lanenet.reading import MEBIBYTE, parsing

__all__ = [
    "LabelIndex",
    "LabelMeta",
    "LabelSet",
    "Source",
    "read_label_group",
    "read_label_index",
    "read_label_points",
    "read_labels",
    "read_places",
    "write_labels",
]

FORMAT = "lanenet-labels/3"
#: Before label sets held their camera.
_WITHOUT_CAMERA = "lanenet-labels/2"
#: Rows of a row group, which training reads one by one where not all fit into memory. Chosen: 17 MB of the
#: densest frames, and still few enough groups in a day of driving.
GROUP_ROWS = 256
#: A row takes at least so many bytes of the file. Measured: rows of a car that stands take 35.
_LEAST_PACKED = 16
Source = Literal["map", "truth"]
Grade = Literal["good", "usable", "reject"]


@dataclass(frozen=True)
class LabelMeta:
    """What all rows of a label set share.

    Attributes:
        window: Bird's-eye window.
        camera_hash: Camera of the edge points.
        wheelbase_cm: Distance between the axles; poses are of the rear axle, labels of the front.
        lane_width_cm: Distance between the middles of the two lines.
        source: ``map`` for labels from a map of the drive, ``truth`` for a simulator's.
        perception: How the edge points were found; the car has to find them the same way.
        marking_cm: Width of the markings; None if unknown.
        config_hash: Hash of the settings that made the labels; empty if unknown.
        camera_cm: Optical centre right of, ahead of and above the front axle; None if unknown.
        camera: Camera of the edge points; None in label sets of format 2.
        verdict: On the map that the labels are from; None if unknown, as in older label sets.
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
    # Compared by its hash.
    camera: Camera | None = field(default=None, compare=False)
    verdict: Grade | None = None


_EDGE_COLUMNS = (
    "edges_x_cm",
    "edges_y_cm",
    "edges_normal_x",
    "edges_normal_y",
    "edges_yellow",
    "edges_red",
)
_LINE_COLUMNS = (("left_line_x_cm", "left_line_y_cm"), ("right_line_x_cm", "right_line_y_cm"))
_DIVIDES_COLUMNS = ("left_divides", "right_divides")
_IMAGE_COLUMN = "image"
_POSE_COLUMNS = ("x_cm", "y_cm", "heading_rad")


@dataclass(frozen=True, eq=False)
class LabelSet:
    """Labelled frames.

    Attributes:
        meta: What all rows share.
        drive: Name of each frame's drive.
        file: Path of each frame's image relative to its drive; empty when there is none.
        frame: Frame number in its drive.
        t_s: Time in its drive.
        lap: Lap in its drive, from 0.
        poses: Rear-axle poses, [cm], [cm], [rad], frame map.
        points_cm: The six labels, frame car; NaN where masked.
        edges: Per frame x, y, normal x, normal y, yellow and red of the edge points, [cm], frame car, see
            :meth:`RoadEdges.rows`.
        lines: Per frame the left and the right line as polylines in the direction of travel, [cm], frame
            car; NaN rows break them.
        quality: 0 (worthless) to 1.
        divides: Whether there is another lane beyond the left, beyond the right line.
    """

    meta: LabelMeta
    drive: list[str]
    file: list[str]
    frame: Int[np.ndarray, "n"]
    t_s: Float[np.ndarray, "n"]
    lap: Int[np.ndarray, "n"]
    poses: Float[np.ndarray, "n 3"]
    points_cm: Float[np.ndarray, "n 6"]
    edges: list[Float[np.ndarray, "_ 6"]]
    lines: list[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]]
    quality: Float[np.ndarray, "n"]
    divides: Bool[np.ndarray, "n 2"]

    def __post_init__(self) -> None:
        for name, values in self._columns().items():
            if len(values) != len(self.frame):
                raise LabelFormatError(f"label set: {len(self.frame)} frames, but {len(values)} of {name!r}")

    def _columns(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(self) if item.name != "meta"}

    def __len__(self) -> int:
        return len(self.frame)

    def raster(self, i: int) -> UInt8[np.ndarray, "p r c"]:
        """Return the bird's-eye raster of row ``i``, with all planes."""
        window = self.meta.window
        return fill_raster(window, RoadEdges.of_rows(self.edges[i]), new_raster(window))

    def in_window(self, window: BirdseyeWindow) -> LabelSet:
        """Return the frames for another bird's-eye window: edge points and lines reach beyond the old one.

        Points beside the old window get their labels from the lines; what was masked inside of it stays so.
        Frames with both lines beside the old window may have been left out when the set was made.
        """
        old = self.meta.window
        if window == old:
            return self
        # Of a map as strictly as when it was labelled.
        rows = label_rows if self.meta.source == "map" else rows_of_polyline
        found = [np.concatenate([rows(line) for line in pair]) for pair in self.lines]
        found_cm = np.array(found, np.float64).reshape(-1, N_POINTS)
        hidden = np.isfinite(old.labelled(found_cm))
        # A frame without any label, with lines in the old window, is not to be labelled.
        hidden |= (hidden.any(axis=1) & np.isnan(self.points_cm).all(axis=1))[:, None]
        beside = np.isnan(self.points_cm) & ~hidden
        points_cm = window.labelled(np.where(beside, found_cm, self.points_cm))
        return replace(self, meta=replace(self.meta, window=window), points_cm=points_cm)

    def subset(self, keep: slice | Bool[np.ndarray, "n"] | Int[np.ndarray, "m"]) -> LabelSet:
        """Return the selected rows, in the given order."""
        rows = np.arange(len(self))[keep]
        kept: dict[str, Any] = {
            name: [values[i] for i in rows] if isinstance(values, list) else values[rows]
            for name, values in self._columns().items()
        }
        return LabelSet(meta=self.meta, **kept)


def write_labels(path: Path, label_set: LabelSet) -> None:
    """Write a label set, atomically.

    Edge points and lines are kept as float32 (1e-5 cm), everything else as float64.

    Raises:
        LabelFormatError: If a value is one that :func:`read_labels` would refuse.
        MissingExtraError: If pyarrow is not installed.
    """
    arrow = require("pyarrow", "data")
    meta = _meta_to_file(label_set.meta, str(path))
    _check_values(label_set, str(path))
    edges = [edge.astype(np.float32) for edge in label_set.edges]
    arrays: dict[str, Any] = {
        "drive": arrow.array(label_set.drive, type=arrow.string()),
        "file": arrow.array(label_set.file, type=arrow.string()),
        "frame": arrow.array(label_set.frame.astype(np.int64)),
        "t_s": float_array(label_set.t_s),
        "lap": arrow.array(label_set.lap.astype(np.int32)),
    }
    arrays |= {name: float_array(label_set.poses[:, k]) for k, name in enumerate(_POSE_COLUMNS)}
    arrays |= {name: float_array(label_set.points_cm[:, k]) for k, name in enumerate(POINT_NAMES)}
    arrays |= {name: list_array([edge[:, k] for edge in edges]) for k, name in enumerate(_EDGE_COLUMNS)}
    for side, names in enumerate(_LINE_COLUMNS):
        arrays |= {n: list_array([line[side][:, k] for line in label_set.lines]) for k, n in enumerate(names)}
    arrays["quality"] = float_array(label_set.quality)
    arrays |= {name: arrow.array(label_set.divides[:, k]) for k, name in enumerate(_DIVIDES_COLUMNS)}
    # Layout and metadata by which Hugging Face `datasets` shows the images.
    image_type = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    window = label_set.meta.window
    images = [
        {"bytes": png_bytes(window.rasterise(edge[:, :2])), "path": f"{drive}_{int(frame):06d}.png"}
        for edge, drive, frame in zip(edges, label_set.drive, label_set.frame, strict=True)
    ]
    arrays[_IMAGE_COLUMN] = arrow.array(images, type=image_type)
    hugging_face = {"info": {"features": {_IMAGE_COLUMN: {"_type": "Image"}}}}
    write_parquet(path, arrays, meta, {b"huggingface": json.dumps(hugging_face).encode()}, GROUP_ROWS)


def read_labels(path: Path) -> LabelSet:
    """Read a label set.

    Raises:
        LabelFormatError: If the file is missing, has another format or other label rows, lacks a column,
            holds an infinite value, or its images do not fit the window; names file and column.
        MissingExtraError: If pyarrow is not installed.
    """
    table = ParquetTable(path)
    return _checked(table, images=True)


def read_label_group(path: Path, group: int) -> LabelSet:
    """Read one row group of a label set, without its images.

    Raises:
        LabelFormatError: As :func:`read_labels`.
    """
    return _checked(ParquetTable(path, group, lambda name: name != _IMAGE_COLUMN), images=False)


def read_places(path: Path) -> LabelSet:
    """Read a label set without what it shows: its frames have no edge points, no lines and no images.

    Raises:
        LabelFormatError: As :func:`read_labels`.
    """
    shown = {_IMAGE_COLUMN, *_EDGE_COLUMNS, *(name for names in _LINE_COLUMNS for name in names)}
    table = ParquetTable(path, columns=lambda name: name not in shown)
    return _checked(table, shown=False, images=False)


def read_label_points(path: Path, group: int) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n"]]:
    """Read the labels and the qualities of one row group, and nothing else.

    Raises:
        LabelFormatError: As :func:`read_labels`.
    """
    table = ParquetTable(path, group, {*POINT_NAMES, "quality"}.__contains__)
    with parsing(path, LabelFormatError):
        return _points_cm(table), table.floats("quality")


@dataclass(frozen=True)
class LabelIndex:
    """What a label set says about itself without any of its rows.

    Attributes:
        meta: What all rows share.
        group_rows: Rows of each row group.
        group_bytes: What each row group unpacks to.
        hash: Of the footer, see :class:`ParquetFooter`.
    """

    meta: LabelMeta
    group_rows: tuple[int, ...]
    group_bytes: tuple[int, ...]
    hash: str


def read_label_index(path: Path) -> LabelIndex:
    """Read what a label set says about itself.

    Raises:
        LabelFormatError: If the file is missing or has another format.
    """
    footer = read_footer(path)
    meta = _meta_from_file(footer.meta, str(path))
    return LabelIndex(meta, footer.group_rows, footer.group_bytes, footer.hash)


def _checked(table: ParquetTable, *, images: bool, shown: bool = True) -> LabelSet:
    """Return the label set of a table: with a look at its images or without, and with its edges and lines."""
    meta = _meta_from_file(table.meta, str(table.path))
    with parsing(table.path, LabelFormatError):
        # First what is cheap: each row takes a kilobyte of memory, whatever it took in the file.
        if len(table) > (size := table.path.stat().st_size) // _LEAST_PACKED:
            raise LabelFormatError(f"{table.path}: {size / MEBIBYTE:.1f} MB stand for {len(table)} rows")
        if images:
            _check_images(table, meta.window)
        label_set = _label_set(table, meta, shown)
    _check_values(label_set, str(table.path))
    return label_set


def _points_cm(table: ParquetTable) -> Float[np.ndarray, "n 6"]:
    return np.stack([table.floats(name, allow_null=True) for name in POINT_NAMES], axis=1)


def _label_set(table: ParquetTable, meta: LabelMeta, shown: bool) -> LabelSet:
    edges: list[np.ndarray] = [np.empty((0, len(_EDGE_COLUMNS)), np.float32)] * len(table)
    left = right = [np.empty((0, 2), np.float32)] * len(table)
    if shown:
        edges = _stacked(_EDGE_COLUMNS, [table.lists(name) for name in _EDGE_COLUMNS], table.path)
        left, right = (
            _stacked(names, [table.lists(name, allow_nan=True) for name in names], table.path)
            for names in _LINE_COLUMNS
        )
    return LabelSet(
        meta=meta,
        drive=table.texts("drive"),
        file=table.texts("file"),
        frame=table.ints("frame"),
        t_s=table.floats("t_s"),
        lap=table.ints("lap"),
        poses=np.stack([table.floats(name) for name in _POSE_COLUMNS], axis=1),
        points_cm=_points_cm(table),
        edges=edges,
        lines=list(zip(left, right, strict=True)),
        quality=table.floats("quality"),
        divides=np.stack([table.flags(name) for name in _DIVIDES_COLUMNS], axis=1),
    )


_UNITS = {"_cm": "centimetre", "_rad": "radian", "_s": "second", "quality": "0 to 1"}


class _MetaFile(Settings):
    """The metadata in the file, see :class:`LabelMeta`."""

    format: Literal["lanenet-labels/3", "lanenet-labels/2"]
    rows_cm: tuple[float, ...]
    order: tuple[str, ...]
    units: dict[str, str]
    window: WindowFile
    camera_hash: str
    wheelbase_cm: float = Field(gt=0.0)
    lane_width_cm: float = Field(gt=0.0)
    source: Source
    perception: PerceptionSettings
    marking_cm: float | None = Field(gt=0.0)
    config_hash: str
    camera_cm: tuple[float, float, float] | None
    camera: CameraFile | None = None
    verdict: Grade | None = None


def _meta_to_file(meta: LabelMeta, where: str) -> dict[str, Any]:
    """Return the metadata as plain values; refuse what :func:`_meta_from_file` would refuse."""
    data = {
        "format": FORMAT,
        "rows_cm": list(ROWS_CM),
        "order": list(POINT_NAMES),
        "units": _UNITS,
        **vars(meta),
        "window": vars(meta.window),
        "perception": meta.perception.model_dump(mode="json"),
        "camera": None if meta.camera is None else _camera_to_file(meta.camera, where),
    }
    _meta_from_file(data, where)
    return data


def _camera_to_file(camera: Camera, where: str) -> dict[str, Any]:
    try:
        return camera_data(camera)
    except CalibrationError as error:
        raise LabelFormatError(f"{where}: {error}") from None


def _meta_from_file(data: dict[str, Any], where: str) -> LabelMeta:
    found = data.get("format")
    if found not in (FORMAT, _WITHOUT_CAMERA):
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
    shared = {item.name: getattr(file, item.name) for item in fields(LabelMeta)}
    camera = None if file.camera is None else file.camera.camera()
    if camera is not None and camera.hash != file.camera_hash:
        raise LabelFormatError(
            f"{where}: its camera has the hash {camera.hash}, but its edge points are of {file.camera_hash}"
        )
    return LabelMeta(**{**shared, "window": file.window.window(), "camera": camera})


def _check_values(label_set: LabelSet, where: str) -> None:
    """Refuse missing and huge numbers; :class:`ParquetTable` has refused most by their column's name."""
    if not np.isfinite(label_set.t_s).all():
        raise LabelFormatError(
            f"{where}: column 't_s': not finite in row {_first(~np.isfinite(label_set.t_s))}"
        )
    places = np.column_stack([label_set.poses, label_set.points_cm])
    for k, name in enumerate((*_POSE_COLUMNS, *POINT_NAMES)):
        # A label may be missing, a pose not.
        outside = ~(np.abs(places[:, k]) <= MAX_PLACE) & ~(np.isnan(places[:, k]) & (name in POINT_NAMES))
        if outside.any():
            row = _first(outside)
            raise LabelFormatError(
                f"{where}: column {name!r}, row {row}: found {places[row, k]:g}, expected at most "
                f"{MAX_PLACE:g}"
            )
    outside = ~((label_set.quality >= 0.0) & (label_set.quality <= 1.0))
    if outside.any():
        raise LabelFormatError(f"{where}: column 'quality': outside 0..1 in row {_first(outside)}")
    for row, (edges, (left, right)) in enumerate(zip(label_set.edges, label_set.lines, strict=True)):
        if not np.isfinite(edges).all():
            raise LabelFormatError(f"{where}: column 'edges_*': not finite in row {row}")
        if np.isinf(left).any() or np.isinf(right).any():
            raise LabelFormatError(f"{where}: column '*_line_*': infinite in row {row}")


def _first(bad: Bool[np.ndarray, "..."]) -> int:
    return int(np.argwhere(bad)[0][0])


def _stacked(names: tuple[str, ...], columns: list[list[np.ndarray]], path: Path) -> list[np.ndarray]:
    """Join the coordinates of each row's points."""
    for row, parts in enumerate(zip(*columns, strict=True)):
        for name, part in zip(names, parts, strict=True):
            if len(part) != len(parts[0]):
                raise LabelFormatError(
                    f"{path}: column {name!r}, row {row}: found {len(part)} values, expected "
                    f"{len(parts[0])} as in {names[0]!r}"
                )
    return [np.stack(parts, axis=1) for parts in zip(*columns, strict=True)]


def _check_images(table: ParquetTable, window: BirdseyeWindow) -> None:
    expected = (window.columns, window.rows)
    for row, image in enumerate(table.raw(_IMAGE_COLUMN)):
        found = image_size(image["bytes"]) if isinstance(image, dict) and image.get("bytes") else None
        if found != expected:
            shown = "no PNG" if found is None else f"{found[0]}x{found[1]} px"
            raise LabelFormatError(
                f"{table.path}: column 'image', row {row}: found {shown}, expected "
                f"{expected[0]}x{expected[1]} px for the window"
            )
