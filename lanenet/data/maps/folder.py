"""The map on disk: a folder with poses, edge points, lane lines, camera, pictures and report."""

from __future__ import annotations

import itertools
import re
import shlex
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int
from pydantic import Field

from lanenet.config import Settings, check_settings, read_yaml
from lanenet.data.camera_file import MAP_CAMERA_NAME, read_own_camera, sigma_residuals, write_camera
from lanenet.data.drives.recording import MAX_TIME_S
from lanenet.data.files import require, write_json, write_text
from lanenet.data.maps.frame_lines import FrameLanes, assign_lanes
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.line import LaneLine
from lanenet.data.tables import (
    MAX_PLACE,
    ColumnSpec,
    ParquetTable,
    read_csv,
    write_columns,
    write_csv,
    write_tum,
)
from lanenet.errors import ConfigError, MapFormatError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, POINT_NAMES, SIDES
from lanenet.outputs import restore_output
from lanenet.reading import FolderFiles, parsing, read_json

FORMAT = "lanenet-map/1"
#: The second format had no sections that the images contradict, the third no kinks.
_LANES_FORMAT, _OLDER_LANES_FORMATS = "lanenet-lanes/4", ("lanenet-lanes/3", "lanenet-lanes/2")
_EDGES_FORMAT = "lanenet-edges/2"
_REPORT_FORMAT = "lanenet-map-report/1"
#: The resolved settings of the mapping, in the map's folder.
SETTINGS_NAME = "settings.yaml"
#: Columns of ``poses.csv``; the last ones, of older maps, say that images contradict the left or right line.
_POSE, _TILT = ("x_cm", "y_cm", "heading_rad"), ("pitch_rad", "roll_rad")
_ERRORS = tuple(
    f"{name}_{point.removesuffix('_cm')}" for name in LabelErrors._fields for point in POINT_NAMES
)
_CONTRADICTED = tuple(f"contradicted_{side}" for side in SIDES)
#: Matched share of a frame's edge points below which its pose is uncertain on older maps. The lowest match
#: in the first 300 frames of data/donkey_circuit is 0.24, the median 0.66.
_MIN_MATCH = 0.15

#: See :mod:`lanenet.data.drives.content`.
_MARK = re.compile(r"[0-9]{1,18}-[0-9a-f]{16}")
#: A map is longer than this. Chosen: the first few frames of the slowest car.
_LEAST_MAP_CM = 1.0
#: Lines of one side, counted from the driven lane; chosen: no model road has as many lanes.
_MAX_RANK = 20
#: Largest size of a match, which is about a share. Chosen: no frame comes near it.
_MOST_MATCH = 100.0


class MapMeta(Settings):
    """What ``map.yaml`` says.

    Attributes:
        format: Kind and version of the folder.
        drive: The drive that was mapped; on disk its full path.
        lane_width_cm: Lane width that the user gave.
        mapped_lane_cm: Distance between the lines on this map.
        tape_cm: Width of the markings on this map.
        scale_from: What sets the scale: the camera's height or the lane width.
        laps: Whole laps between revisits; 0 without a revisit.
        markings: Whether the markings are lighter or darker than the floor.
        ahead_sigma_cm: Sigma of distances ahead of the car at the far label row, where the camera was found
            from the drive, see :func:`datagen.lanes.scale.ahead_sigma`; 0 for a given camera.
        verdict: How far its labels can be trusted; None until it has been judged.
        state: Whether the map as a whole is closed, open, or wrong in sections; None until it has been
            judged, and in a map of an earlier version.
        options: Options of ``lanenet map`` that asked for the map, but for the lane width; a config stands as
            ``CONFIG``. None in a map of an earlier version.
    """

    format: str
    drive: str
    lane_width_cm: float = Field(gt=0.0, le=MAX_PLACE)
    mapped_lane_cm: float = Field(gt=0.0, le=MAX_PLACE)
    tape_cm: float = Field(ge=0.0, le=MAX_PLACE)
    scale_from: str
    laps: int = Field(ge=0)
    markings: Literal["light", "dark"] = "light"
    ahead_sigma_cm: float = Field(default=0.0, ge=0.0, le=MAX_PLACE)
    verdict: Literal["good", "usable", "reject"] | None = None
    state: Literal["closed", "open", "wrong in sections"] | None = None
    options: tuple[str, ...] | None = None

    def command(self, folder: Path, lane_width_cm: float | None = None) -> str:
        """Return the command that maps the drive again, or with another lane width.

        Args:
            folder: Of the map.
            lane_width_cm: None for the map's own.
        """
        width_cm = self.lane_width_cm if lane_width_cm is None else lane_width_cm
        words = ["lanenet", "map", self.drive, "--lane-width", f"{width_cm:g}", *(self.options or ())]
        return shlex.join([*words, "--out", str(folder)])

    def width_command(self, folder: Path, lane_width_cm: float) -> str:
        """Say by which command the map gets another lane width, and what that does."""
        # What the images show without its height is rescaled; else the lane width finds the focal length.
        scales = self.options is not None and self.scale_from != "camera"
        scales = scales and "--camera-height" not in (self.options or ())
        how = "rescale it, which takes seconds" if scales else "map it anew"
        return f"{how}: {self.command(folder, lane_width_cm)}"

    @property
    def lane_cm(self) -> float:
        """Lane width: the measured one if the camera sets the scale, else the given one."""
        return self.mapped_lane_cm if self.scale_from == "camera" else self.lane_width_cm


@dataclass(frozen=True)
class DriveMap:
    """A mapped drive.

    Attributes:
        meta: Origin and scale.
        camera: The camera that was used or found.
        frames: Frame numbers of the drive.
        t_s: Time of each frame.
        poses: Rear-axle x, y, heading (unwrapped) per frame, frame map.
        lap: Lap of each frame, from 0.
        segment: Segment of each frame.
        s_cm: Position along the segment's path; on a closed lap less than its length.
        match: Matched share of each frame's edges; below 0 where most face the other way, NaN without edges.
        lines: Lines of each segment: left and right of the driven lane, then those of adjacent lanes.
        tilt_rad: Pitch and roll of each frame, added to the camera's mounting.
        held_out: Frames whose edge points were not used for the lines.
        errors: Predicted errors of the labels, see :mod:`datagen.quality.label_error`.
        marks: By what the image of each frame is known again, see
            :func:`lanenet.data.drives.content.image_marks`; None in a map of an earlier version.
    """

    meta: MapMeta
    camera: Camera
    frames: Int[np.ndarray, "n"]
    t_s: Float[np.ndarray, "n"]
    poses: Float[np.ndarray, "n 3"]
    lap: Int[np.ndarray, "n"]
    segment: Int[np.ndarray, "n"]
    s_cm: Float[np.ndarray, "n"]
    match: Float[np.ndarray, "n"]
    lines: dict[int, list[LaneLine]]
    tilt_rad: Float[np.ndarray, "n 2"]
    held_out: Bool[np.ndarray, "n"]
    errors: LabelErrors
    marks: tuple[str, ...] | None = None

    def camera_at(self, k: int) -> Camera:
        """Return the camera with the tilt of the k-th frame."""
        m = self.camera.mounting
        pitch, roll = (float(angle) for angle in self.tilt_rad[k])
        return self.camera.with_mounting(pitch_down_rad=m.pitch_down_rad + pitch, roll_rad=m.roll_rad + roll)

    def without_doubts(self) -> DriveMap:
        """Return the map as it was before it was judged: nothing of it is withheld."""
        lines = {
            segment: [replace(line, contradicted_cm=np.empty((0, 2))) for line in found]
            for segment, found in self.lines.items()
        }
        return replace(self, lines=lines, errors=LabelErrors.none(len(self.frames)))

    @cached_property
    def lanes(self) -> FrameLanes:
        """The lane of each frame."""
        n = len(self.frames)
        lane, forward = np.zeros(n, dtype=np.int64), np.ones(n, dtype=bool)
        between, away = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        divides = np.zeros((n, len(SIDES)), dtype=bool)
        for segment, lines in self.lines.items():
            rows = np.flatnonzero(self.segment == segment)
            found = assign_lanes(lines, self.poses[rows], self.s_cm[rows], self.camera.wheelbase_cm)
            lane[rows], forward[rows] = found.lane, found.forward
            between[rows], away[rows], divides[rows] = found.between, found.away, found.divides
        return FrameLanes(lane, forward, between, away, divides)


def sigma_in_report(report: dict[str, Any]) -> dict[str, float]:
    """Return the sigmas of a map's camera, found from its drive or brought along; empty for an exact one."""
    sigma: dict[str, float] = report.get("calibration", {}).get("sigma") or report.get("camera_sigma", {})
    return sigma


def write_map(
    folder: Path,
    drive_map: DriveMap,
    edges: dict[str, np.ndarray],
    report: dict[str, Any],
    how_calibrated: str,
) -> None:
    """Write a map, without its pictures, into an existing folder."""
    m = drive_map
    columns: dict[str, Any] = {
        "frame": m.frames,
        "t_s": m.t_s,
        **dict(zip(_POSE, m.poses.T, strict=True)),
        "lap": m.lap,
        "segment": m.segment,
        "s_cm": m.s_cm,
        "match": m.match,
        **dict(zip(_TILT, m.tilt_rad.T, strict=True)),
        "held_out": m.held_out,
        **dict(zip(_ERRORS, np.concatenate(m.errors, axis=1).T, strict=True)),
    }
    if m.marks is not None:
        columns["image"] = m.marks
    write_csv(folder / "poses.csv", columns, allow_empty=("match", *_ERRORS))
    write_tum(folder / "trajectory.tum", m.t_s, m.poses)
    sigma = sigma_residuals(m.camera, sigma_in_report(report))
    write_camera(folder / "camera.yaml", m.camera, how_calibrated, sigma)
    lines = [
        {
            "segment": segment,
            "side": line.side,
            "rank": line.rank,
            "degree": 3,
            "period_cm": line.period_cm,
            "knots_cm": line.knots_cm,
            "coefficients_cm": line.coefficients_cm,
            "supported_cm": line.supported_cm,
            "residual_cm": line.residual_cm,
            "marking_cm": line.marking_cm,
            "marking_at_cm": line.marking_at_cm,
            "bare_share": line.unpainted,
            "sigma_s_cm": line.sigma_s_cm,
            "sigma_at_cm": line.sigma_at_cm,
            "contradicted_cm": line.contradicted_cm,
        }
        for segment, pair in m.lines.items()
        for line in pair
    ]
    write_json(folder / "lanes.json", {"format": _LANES_FORMAT, "lines": lines})
    write_columns(folder / "edges.parquet", edges, {"format": _EDGES_FORMAT})
    write_json(folder / "report.json", {"format": _REPORT_FORMAT, **report})
    # The full path, so that the drive is found from any working folder.
    meta = {**m.meta.model_dump(), "drive": str(Path(m.meta.drive).resolve())}
    write_text(folder / "map.yaml", yaml.safe_dump(meta, sort_keys=False))


def read_map_meta(folder: Path) -> MapMeta:
    """Read what ``map.yaml`` says.

    Raises:
        MapFormatError: If it is not a map, is of another version, or the file is damaged.
    """
    restore_output(folder)
    if not (folder / "map.yaml").is_file():
        refused = (folder / "refused.yaml").is_file()
        joined = (folder / "joined.yaml").is_file()
        why = f"its drive was refused, see {folder / 'report.html'}" if refused else "no map.yaml in it"
        why = "it holds joined maps: give that of one drive in it" if joined else why
        raise MapFormatError(f"{folder}: is not a map ({why})")
    path = FolderFiles(folder).file("map.yaml", folder, MapFormatError)
    plain = read_yaml(path, MapFormatError)
    if plain.get("format") != FORMAT:
        raise MapFormatError(f"{path}: format is {plain.get('format')!r}, expected {FORMAT!r}")
    try:
        return check_settings(MapMeta, plain, str(path))
    except ConfigError as error:
        raise MapFormatError(str(error)) from None


def read_map(folder: Path) -> DriveMap:
    """Read a map folder.

    Raises:
        MapFormatError: If it is not a map, is of another version, or a file is damaged.
    """
    meta = read_map_meta(folder)
    inside = FolderFiles(folder)
    place = ColumnSpec(low=-MAX_PLACE, high=MAX_PLACE)
    poses = inside.file("poses.csv", folder, MapFormatError)
    table = read_csv(
        poses,
        {
            "frame": ColumnSpec("int", low=0.0, increasing=True),
            **{name: ColumnSpec("int", low=0.0, high=MAX_PLACE) for name in ("lap", "segment")},
            **dict.fromkeys((*_POSE, "s_cm", *_TILT), place),
            "t_s": ColumnSpec(low=-MAX_TIME_S, high=MAX_TIME_S),
            # Below 0 where most edges face the other way than those of the map.
            "match": ColumnSpec(allow_empty=True, low=-_MOST_MATCH, high=_MOST_MATCH),
            "held_out": ColumnSpec("int", low=0.0, high=1.0),
            **dict.fromkeys(_ERRORS, ColumnSpec(required=False, allow_empty=True, low=0.0, high=MAX_PLACE)),
            **dict.fromkeys(_CONTRADICTED, ColumnSpec("int", required=False, low=0.0, high=1.0)),
            "image": ColumnSpec("text", required=False, allow_empty=True),
        },
        error=MapFormatError,
    )
    _check_poses(poses, table)
    lines = inside.file("lanes.json", folder, MapFormatError)
    return DriveMap(
        meta=meta,
        camera=read_own_camera(inside.file(MAP_CAMERA_NAME, folder, MapFormatError)),
        frames=table["frame"],
        t_s=table["t_s"],
        poses=np.stack([table[name] for name in _POSE], axis=1),
        lap=table["lap"],
        segment=table["segment"],
        s_cm=table["s_cm"],
        match=table["match"],
        lines=_read_lines(lines, {int(segment) for segment in table["segment"]}),
        tilt_rad=np.stack([table[name] for name in _TILT], axis=1),
        held_out=table["held_out"] > 0,
        errors=_read_errors(poses, table),
        marks=None if "image" not in table else tuple(table["image"].tolist()),
    )


def _read_errors(path: Path, table: dict[str, np.ndarray]) -> LabelErrors:
    """The errors of the labels; an older map withholds what images contradict, and where few edges match."""
    older = any(name in table for name in _CONTRADICTED)
    names = _CONTRADICTED if older else _ERRORS
    if missing := [name for name in names if name not in table]:
        raise MapFormatError(f"{path}: no column {missing[0]!r}")
    columns = np.stack([table[name] for name in names], axis=1)
    if older:
        uncertain = ~(table["match"] >= _MIN_MATCH)[:, None]
        return LabelErrors.withholding(np.repeat((columns > 0) | uncertain, N_POINTS // len(SIDES), axis=1))
    return LabelErrors(*np.split(columns, len(LabelErrors._fields), axis=1))


def _check_poses(path: Path, table: dict[str, np.ndarray]) -> None:
    """Refuse poses that no drive has: none, or a car that never moved; and what is no mark of an image."""
    n = len(table["frame"])
    if n == 0:
        raise MapFormatError(f"{path}: no frames")
    across_cm = max(float(np.ptp(table[name])) for name in ("x_cm", "y_cm"))
    if n > 1 and across_cm < _LEAST_MAP_CM:
        raise MapFormatError(
            f"{path}: all {n} frames lie within {across_cm:g} cm, expected at least {_LEAST_MAP_CM:g} cm"
        )
    strange = [mark for mark in table.get("image", ()) if mark and not _MARK.fullmatch(mark)]
    if strange:
        raise MapFormatError(f"{path}: column 'image': expected SIZE-DIGEST, found {strange[0][:40]!r}")


class MapVerdict(NamedTuple):
    """How far a map can be trusted, as its report has it.

    Attributes:
        grade: ``good``, ``usable`` or ``reject``.
        sentence: What that comes from and what to do about it.
        reasons: The figures behind it; none in a report of an older version.
        remarks: What a person should check.
    """

    grade: str
    sentence: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]


def verdict_of(folder: Path) -> MapVerdict:
    """Return the verdict on a map.

    Raises:
        MapFormatError: If the map's report cannot be read.
    """
    file = folder / "report.json"
    plain = read_json(file, MapFormatError)
    with parsing(f"{file}: key 'verdict'", MapFormatError):
        verdict = plain["verdict"]
        return MapVerdict(
            str(verdict["grade"]),
            str(verdict["sentence"]),
            tuple(map(str, verdict.get("reasons", ()))),
            tuple(map(str, verdict["remarks"])),
        )


def check_map_files(folder: Path) -> None:
    """Read all of a map that was written.

    Raises:
        LanenetError: If a file cannot be read.
    """
    read_map(folder)
    require("pyarrow.parquet", "data").read_table(folder / "edges.parquet")


def read_edges(folder: Path) -> Float[np.ndarray, "n 2"]:
    """Return the edge points of a map, [cm], frame map.

    Raises:
        LabelFormatError: If there is no such file, it cannot be read, or lacks a column.
        MissingExtraError: If pyarrow is not installed.
    """
    table = ParquetTable(FolderFiles(folder).file("edges.parquet", folder, MapFormatError))
    return np.column_stack([table.floats(name) for name in ("x_cm", "y_cm")])


def kept_map(out: Path) -> str:
    """Say, after a mapping failed, that the map in its output folder is an older one.

    Args:
        out: Where the new map was to be written.

    Returns:
        The end of a sentence; empty if there is no map.
    """
    if not (out / "map.yaml").is_file():
        return ""
    try:
        verdict = read_yaml(out / "map.yaml").get("verdict")
    except ConfigError:  # a damaged map was kept, too
        verdict = None
    return f"; the map at {out} is an older one, which was kept (verdict: {verdict or 'none'})"


def _read_lines(path: Path, segments: set[int]) -> dict[int, list[LaneLine]]:
    plain = read_json(path, MapFormatError)
    with parsing(f"{path}: lane lines cannot be read", MapFormatError):
        if plain["format"] not in (_LANES_FORMAT, *_OLDER_LANES_FORMATS):
            raise MapFormatError(f"{path}: format is {plain['format']!r}, expected {_LANES_FORMAT!r}")
        lines: dict[int, list[LaneLine]] = {}
        for item in plain["lines"]:
            if plain["format"] == _OLDER_LANES_FORMATS[1]:
                item["contradicted_cm"] = []
            lines.setdefault(int(item["segment"]), []).append(_line(item))
    for segment in sorted(segments):
        found = sorted(line.index for line in lines.get(segment, []))
        # No gaps: a lane lies between neighbouring lines.
        if not {0, 1} <= set(found) or found != list(range(found[0], found[-1] + 1)):
            raise MapFormatError(
                f"{path}: segment {segment} has lines {found} from left to right, expected consecutive "
                "numbers that include 0 and 1, the lines of the driven lane"
            )
        _check_sides(path, segment, sorted(lines[segment], key=lambda line: line.index))
    return lines


def _check_sides(path: Path, segment: int, lines: list[LaneLine]) -> None:
    """Refuse lines that do not lie beside each other in their order, seen in the path's direction."""
    for left, right in itertools.pairwise(lines):
        if not left.lies_left_of(right):
            raise MapFormatError(
                f"{path}: segment {segment}: line {left.index} does not lie to the left of line {right.index}"
            )


def _line(item: dict[str, Any]) -> LaneLine:
    knots, coefficients, supported, contradicted, sigma_s, sigma_at = (
        np.array(item[f"{name}_cm"], dtype=np.float64)
        for name in ("knots", "coefficients", "supported", "contradicted", "sigma_s", "sigma_at")
    )
    # Older maps have one width for each line.
    widths = np.array(item.get("marking_at_cm", []), dtype=np.float64)
    if item["side"] not in ("left", "right"):
        raise ValueError(f"side is {item['side']!r}")
    if knots.ndim != 1 or len(knots) < 8 or coefficients.shape != (len(knots) - 4, 2):
        raise ValueError(f"{len(knots)} knots with coefficients of shape {coefficients.shape}")
    supported, contradicted = supported.reshape(-1, 2), contradicted.reshape(-1, 2)
    if not all(
        (np.abs(values) <= MAX_PLACE).all()
        for values in (knots, coefficients, supported, contradicted, sigma_s, sigma_at, widths)
    ):
        raise ValueError(f"all numbers must be finite and at most {MAX_PLACE:g}")
    # Four at either end may be equal, where the line begins and ends, and three in between, at a kink.
    inner = knots[4:-4]
    if not (
        (np.diff(knots) >= 0.0).all()
        and (inner[3:] > inner[:-3]).all()
        and knots[3] < knots[4]
        and knots[-5] < knots[-4]
    ):
        raise ValueError("knots_cm must increase")
    for name, sections in (("supported_cm", supported), ("contradicted_cm", contradicted)):
        if not (sections[:, 1] >= sections[:, 0]).all():
            raise ValueError(f"{name} must hold sections (from, to)")
    rank, period = item["rank"], item["period_cm"]
    if type(rank) is not int or not 0 <= rank <= _MAX_RANK:
        raise ValueError(f"rank is {rank!r}, expected 0 to {_MAX_RANK}")
    if period is not None and not np.isclose(knots[-4] - knots[3], period):
        raise ValueError(f"period_cm is {period}, the knots span {knots[-4] - knots[3]}")
    if sigma_s.ndim != 1 or sigma_s.shape != sigma_at.shape:
        raise ValueError(f"sigma_at_cm has shape {sigma_at.shape}, sigma_s_cm {sigma_s.shape}")
    if not ((np.diff(sigma_s) >= 0.0).all() and (sigma_at >= 0.0).all()):
        raise ValueError("sigma_s_cm must not decrease, and sigma_at_cm not be negative")
    if widths.shape not in ((0,), sigma_s.shape) or not (widths > 0.0).all():
        raise ValueError(f"marking_at_cm has shape {widths.shape}, expected {sigma_s.shape}, all positive")
    residual, marking, unpainted = (
        float("nan") if item[name] is None else float(item[name])
        for name in ("residual_cm", "marking_cm", "bare_share")
    )
    for name, value, most in (
        ("residual_cm", residual, MAX_PLACE),
        ("marking_cm", marking, MAX_PLACE),
        ("bare_share", unpainted, 1.0),
    ):
        if value < 0.0 or value > most:
            raise ValueError(f"{name} is {value:g}, expected 0 to {most:g}")
    return LaneLine(
        side=item["side"],
        knots_cm=knots,
        coefficients_cm=coefficients,
        supported_cm=supported,
        residual_cm=residual,
        rank=rank,
        period_cm=None if period is None else float(period),
        sigma_s_cm=sigma_s,
        sigma_at_cm=sigma_at,
        marking_cm=marking,
        marking_at_cm=widths,
        unpainted=unpainted,
        contradicted_cm=contradicted,
    )
