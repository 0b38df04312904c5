"""The map on disk: a folder with poses, edges, lane lines, the camera, pictures and the report's figures."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int

from lanenet.config import Settings, check_settings, read_yaml
from lanenet.data.camera_file import read_camera, write_camera
from lanenet.data.files import write_json, write_text
from lanenet.data.maps.lanes import FrameLanes, assign_lanes
from lanenet.data.maps.line import LaneLine
from lanenet.data.parquet import write_columns
from lanenet.data.tables import ColumnSpec, read_csv, write_csv
from lanenet.data.trajectory import write_tum
from lanenet.errors import ConfigError, MapFormatError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import SIDES

FORMAT = "lanenet-map/1"
#: The first version has a left and a right line per segment, without period and uncertainty.
LANES_FORMATS = ("lanenet-lanes/1", "lanenet-lanes/2")
#: The resolved settings of the mapping, in the map's folder.
SETTINGS_NAME = "settings.yaml"
REPORT_FORMAT = "lanenet-map-report/1"
EDGES_FORMAT = "lanenet-edges/2"
#: Columns of ``poses.csv`` that say with which line of a frame the pictures around it disagree.
_CONTRADICTED = tuple(f"contradicted_{side}" for side in SIDES)


class MapMeta(Settings):
    """What ``map.yaml`` says.

    Attributes:
        format: Kind and version of the folder.
        drive: The drive that was mapped. On disk its full path; older maps hold it as it was typed, from
            the folder in which the command ran.
        lane_width_cm: Lane width that the user gave.
        mapped_lane_cm: Distance between the lines on this map.
        tape_cm: Width of the markings on this map.
        scale_from: What sets the scale: the camera's height or the lane width.
        laps: Whole laps between revisits, 0 where no place was seen twice.
        verdict: How far the map can be trusted, see :mod:`datagen.quality.verdict`; older maps have none.
    """

    format: str
    drive: str
    lane_width_cm: float
    mapped_lane_cm: float
    tape_cm: float
    scale_from: str
    laps: int
    verdict: Literal["good", "usable", "reject"] | None = None

    @property
    def lane_cm(self) -> float:
        """Width of the lane: as measured where the camera sets the scale, else what sets it."""
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
        segment: Uninterrupted stretch of the drive that each frame belongs to.
        s_cm: Position along the segment's path; on a closed lap below its length.
        match: Matched share of each frame's edges, 0..1.
        lines: Left and right line of the driven lane of each segment, then those of the lanes beside it.
        tilt_rad: Pitch and roll of each frame beyond the camera's mounting; None for level.
        held_out: Frames whose edge points had no say in the lines; None where there were none.
        contradicted: Frames around which the pictures disagree with the left, with the right line, see
            :mod:`datagen.quality.agreement`; None where nobody looked.
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
    tilt_rad: Float[np.ndarray, "n 2"] | None = None
    held_out: Bool[np.ndarray, "n"] | None = None
    contradicted: Bool[np.ndarray, "n 2"] | None = None

    def camera_at(self, k: int) -> Camera:
        """Return the camera as it nodded in the k-th frame."""
        if self.tilt_rad is None:
            return self.camera
        m = self.camera.mounting
        pitch, roll = (float(angle) for angle in self.tilt_rad[k])
        return self.camera.with_mounting(pitch_down_rad=m.pitch_down_rad + pitch, roll_rad=m.roll_rad + roll)

    @cached_property
    def lanes(self) -> FrameLanes:
        """The lane of each frame, and its direction of travel along the segment's path."""
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


def write_map(
    folder: Path,
    drive_map: DriveMap,
    edges: dict[str, np.ndarray],
    report: dict[str, Any],
    how_calibrated: str,
) -> None:
    """Write a map into an existing (temporary) folder; pictures are the caller's."""
    m = drive_map
    columns = {
        "frame": m.frames,
        "t_s": m.t_s,
        "x_cm": m.poses[:, 0],
        "y_cm": m.poses[:, 1],
        "heading_rad": m.poses[:, 2],
        "lap": m.lap,
        "segment": m.segment,
        "s_cm": m.s_cm,
        "match": m.match,
    }
    if m.tilt_rad is not None:
        columns |= {"pitch_rad": m.tilt_rad[:, 0], "roll_rad": m.tilt_rad[:, 1]}
    if m.held_out is not None:
        columns["held_out"] = m.held_out
    if m.contradicted is not None:
        columns |= dict(zip(_CONTRADICTED, m.contradicted.T, strict=True))
    write_csv(folder / "poses.csv", columns, allow_empty=("match",))
    write_tum(folder / "trajectory.tum", m.t_s, m.poses)
    write_camera(folder / "camera.yaml", m.camera, how_calibrated)
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
            "bare_share": line.bare,
            "sigma_s_cm": line.sigma_s_cm,
            "sigma_at_cm": line.sigma_at_cm,
        }
        for segment, pair in m.lines.items()
        for line in pair
    ]
    write_json(folder / "lanes.json", {"format": LANES_FORMATS[-1], "lines": lines})
    write_columns(folder / "edges.parquet", edges, {"format": EDGES_FORMAT})
    write_json(folder / "report.json", {"format": REPORT_FORMAT, **report})
    # In full, so that the map leads to its drive from any folder.
    meta = {**m.meta.model_dump(), "drive": str(Path(m.meta.drive).resolve())}
    write_text(folder / "map.yaml", yaml.safe_dump(meta, sort_keys=False))


def read_map(folder: Path) -> DriveMap:
    """Read a map folder.

    Raises:
        MapFormatError: If it is not a map, is of another version, or a file is damaged.
    """
    if not (folder / "map.yaml").is_file():
        raise MapFormatError(f"{folder}: is not a map (no map.yaml in it)")
    try:
        plain = read_yaml(folder / "map.yaml")
        if plain.get("format") != FORMAT:
            raise MapFormatError(
                f"{folder / 'map.yaml'}: format is {plain.get('format')!r}, expected {FORMAT!r}"
            )
        meta = check_settings(MapMeta, plain, str(folder / "map.yaml"))
    except ConfigError as error:
        raise MapFormatError(str(error)) from None
    table = read_csv(
        folder / "poses.csv",
        {
            "frame": ColumnSpec("int"),
            "t_s": ColumnSpec(),
            "x_cm": ColumnSpec(),
            "y_cm": ColumnSpec(),
            "heading_rad": ColumnSpec(),
            "lap": ColumnSpec("int"),
            "segment": ColumnSpec("int"),
            "s_cm": ColumnSpec(),
            "match": ColumnSpec(allow_empty=True),
            # Older maps lack these.
            "pitch_rad": ColumnSpec(required=False),
            "roll_rad": ColumnSpec(required=False),
            "held_out": ColumnSpec("int", required=False, low=0.0, high=1.0),
            **{name: ColumnSpec("int", required=False, low=0.0, high=1.0) for name in _CONTRADICTED},
            # Some older maps say it of both lines together.
            "contradicted": ColumnSpec("int", required=False, low=0.0, high=1.0),
        },
        error=MapFormatError,
    )
    n = len(table["frame"])
    tilt = [table.get(name, np.zeros(n)) for name in ("pitch_rad", "roll_rad")]
    both = table.get("contradicted", np.zeros(n))
    return DriveMap(
        meta=meta,
        camera=read_camera(folder / "camera.yaml"),
        frames=table["frame"],
        t_s=table["t_s"],
        poses=np.stack([table["x_cm"], table["y_cm"], table["heading_rad"]], axis=1),
        lap=table["lap"],
        segment=table["segment"],
        s_cm=table["s_cm"],
        match=table["match"],
        lines=_read_lines(folder / "lanes.json", {int(segment) for segment in table["segment"]}),
        tilt_rad=np.stack(tilt, axis=1),
        held_out=table.get("held_out", np.zeros(n)) > 0,
        contradicted=np.stack([table.get(name, both) for name in _CONTRADICTED], axis=1) > 0,
    )


def kept_map(out: Path) -> str:
    """Say, after a refusal, that the map which lies where the new one was to be written is an older one.

    Args:
        out: Where the new one was to be written.

    Returns:
        The end of a sentence; empty where no map lies there.
    """
    if not (out / "map.yaml").is_file():
        return ""
    try:
        verdict = read_yaml(out / "map.yaml").get("verdict")
    except ConfigError:  # it was kept, whatever it is
        verdict = None
    return f"; the map at {out} is an older one, which was kept (verdict: {verdict or 'none'})"


def _read_lines(path: Path, segments: set[int]) -> dict[int, list[LaneLine]]:
    try:
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain["format"] not in LANES_FORMATS:
            raise MapFormatError(f"{path}: format is {plain['format']!r}, expected {LANES_FORMATS[-1]!r}")
        lines: dict[int, list[LaneLine]] = {}
        for item in plain["lines"]:
            lines.setdefault(int(item["segment"]), []).append(_line(item))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise MapFormatError(f"{path}: lane lines cannot be read ({error!r})") from None
    for segment in sorted(segments):
        found = sorted(line.index for line in lines.get(segment, []))
        # Without gaps from left to right: a lane lies between neighbouring numbers.
        if not {0, 1} <= set(found) or found != list(range(found[0], found[-1] + 1)):
            raise MapFormatError(
                f"{path}: segment {segment} has lines {found} from left to right, expected one each, among "
                "them 0 and 1, the left and right line of the driven lane"
            )
    return lines


def _line(item: dict[str, Any]) -> LaneLine:
    knots, coefficients, supported = (
        np.array(item[name], dtype=np.float64) for name in ("knots_cm", "coefficients_cm", "supported_cm")
    )
    if item["side"] not in ("left", "right"):
        raise ValueError(f"side is {item['side']!r}")
    if len(knots) < 8 or coefficients.shape != (len(knots) - 4, 2):
        raise ValueError(f"{len(knots)} knots with coefficients of shape {coefficients.shape}")
    if not (np.isfinite(knots).all() and np.isfinite(coefficients).all() and (np.diff(knots) >= 0.0).all()):
        raise ValueError("knots must not decrease, and all numbers must be finite")
    rank, period = int(item.get("rank", 0)), _optional(item.get("period_cm"))
    if rank < 0:
        raise ValueError(f"rank is {rank}")
    if period is not None and not np.isclose(knots[-4] - knots[3], period):
        raise ValueError(f"period_cm is {period}, the knots span {knots[-4] - knots[3]}")
    sigma_s, sigma_at = (
        np.array(item.get(name, []), dtype=np.float64) for name in ("sigma_s_cm", "sigma_at_cm")
    )
    if sigma_s.ndim != 1 or sigma_s.shape != sigma_at.shape or not np.isfinite([*sigma_s, *sigma_at]).all():
        raise ValueError(f"uncertainty of shape {sigma_at.shape} at places of shape {sigma_s.shape}")
    known = (
        _optional(item["residual_cm"]),
        _optional(item.get("marking_cm")),
        _optional(item.get("bare_share")),
    )
    residual, marking, bare = (float("nan") if number is None else number for number in known)
    return LaneLine(
        item["side"],
        knots,
        coefficients,
        supported.reshape(-1, 2),
        residual,
        rank,
        period,
        sigma_s,
        sigma_at,
        marking,
        bare,
    )


def _optional(value: Any) -> float | None:
    return None if value is None else float(value)
