"""The shape of a track as a map has it: lane lines, where the car has been, and marks beside the lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from lanenet.data.maps.folder import DriveMap, read_map
from lanenet.data.maps.line import LaneLine
from lanenet.data.tables import ParquetTable
from lanenet.geometry.poses import path_lengths

#: Spacing of the samples of lines and of paths, [cm]. Chosen: tape is wider, corners are followed.
STEP_CM, _PATH_STEP_CM = 2.0, 4.0
#: How far from where a map guesses a line it may be, in lane widths. Chosen: gaps are bridged by cubics.
_UNKNOWN_LANES = 0.3
#: Edge points up to this distance from the rear axle make marks, in lane widths. Chosen: further ones scatter
#: by more than a mark is wide.
_MARK_LANES = 1.6
#: Marks nearer to a line than this share of the lane width are the line's own, or lie across it; cell of the
#: map in which edge points are one mark, [cm], ways it may face, and frames that must have seen it.
_OFF_LINE, _CELL_CM, _WAYS, _LEAST_SEEN = 0.12, 1.5, 8, 5


@dataclass(frozen=True)
class Similarity:
    """Moves points of one map onto another one: scaled, turned, then shifted.

    Attributes:
        x_cm: Shift along x.
        y_cm: Shift along y.
        turn_rad: Counter-clockwise.
        scale: Lengths on the other map over lengths on this one.
    """

    x_cm: float = 0.0
    y_cm: float = 0.0
    turn_rad: float = 0.0
    scale: float = 1.0

    def points(self, xy_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Move points."""
        return self.scale * self.directions(xy_cm) + [self.x_cm, self.y_cm]

    def directions(self, unit: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn directions."""
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.asarray(unit @ np.array([[c, s], [-s, c]]))

    def poses(self, poses: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Move poses; headings stay unwrapped."""
        return np.column_stack([self.points(poses[:, :2]), poses[:, 2] + self.turn_rad])

    def then(self, other: Similarity) -> Similarity:
        """Return both moves, one after the other."""
        x, y = other.points(np.array([[self.x_cm, self.y_cm]]))[0]
        return Similarity(float(x), float(y), self.turn_rad + other.turn_rad, self.scale * other.scale)

    @property
    def inverse(self) -> Similarity:
        """The way back."""
        back = Similarity(0.0, 0.0, -self.turn_rad, 1.0 / self.scale)
        x, y = -back.points(np.array([[self.x_cm, self.y_cm]]))[0]
        return replace(back, x_cm=float(x), y_cm=float(y))


@dataclass(frozen=True, eq=False)
class SampledLine:
    """A lane line as points, evenly along it.

    Attributes:
        index: Number of the line from left to right; 0 and 1 bound the driven lane.
        xy_cm: Points, frame map.
        tangent: Unit vectors along the line there.
        known: Where the map has seen the line and no image contradicts it.
        closed: Whether the last point is followed by the first.
        sigma_cm: Of each point's position across the line; NaN where unknown.
        unpainted: Share of it without paint; NaN if unknown.
    """

    index: int
    xy_cm: Float[np.ndarray, "m 2"]
    tangent: Float[np.ndarray, "m 2"]
    known: Bool[np.ndarray, "m"]
    closed: bool
    sigma_cm: Float[np.ndarray, "m"]
    unpainted: float = float("nan")


@dataclass(frozen=True, eq=False)
class TrackShape:
    """What a map knows of its track.

    Attributes:
        name: Of the map, for messages.
        lane_cm: Lane width.
        lines: Its lines.
        path_cm: Where the rear axle was, thinned.
        marks_cm: Places beside the lines where many frames saw an edge.
        mark_normals: Unit normals of these, to the brighter side.
    """

    name: str
    lane_cm: float
    lines: tuple[SampledLine, ...]
    path_cm: Float[np.ndarray, "p 2"]
    marks_cm: Float[np.ndarray, "k 2"]
    mark_normals: Float[np.ndarray, "k 2"]

    @property
    def closed(self) -> bool:
        """Whether the map holds a whole lap."""
        return self.lines[0].closed

    @cached_property
    def points_cm(self) -> Float[np.ndarray, "m 2"]:
        """The known points of all lines."""
        return np.concatenate([line.xy_cm[line.known] for line in self.lines])

    @cached_property
    def tangents(self) -> Float[np.ndarray, "m 2"]:
        """Directions of the lines at :attr:`points_cm`."""
        return np.concatenate([line.tangent[line.known] for line in self.lines])

    @cached_property
    def sigma_cm(self) -> Float[np.ndarray, "m"]:
        """Sigma of :attr:`points_cm` across their lines; 0 where unknown."""
        return np.nan_to_num(np.concatenate([line.sigma_cm[line.known] for line in self.lines]))

    @cached_property
    def tree(self) -> cKDTree:
        """Finds the nearest of :attr:`points_cm`."""
        return cKDTree(self.points_cm)

    def surveyed(self, xy_cm: Float[np.ndarray, "n 2"], reach_lanes: float = 1.0) -> Bool[np.ndarray, "n"]:
        """Find which places the car was near enough to that its map would have them."""
        apart, nearest = cKDTree(self.path_cm).query(xy_cm)
        near = apart < reach_lanes * self.lane_cm
        # Beyond the ends of an open road nothing is known.
        return np.asarray(near if self.closed else near & (nearest > 0) & (nearest < len(self.path_cm) - 1))

    def unknown(self, xy_cm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Find places near which the map has a line that it did not see there."""
        guessed = np.concatenate([line.xy_cm[~line.known] for line in self.lines])
        if not len(guessed):
            return np.zeros(len(xy_cm), dtype=bool)
        apart, _ = cKDTree(guessed).query(xy_cm, distance_upper_bound=_UNKNOWN_LANES * self.lane_cm)
        return np.asarray(np.isfinite(apart))

    def moved(self, by: Similarity) -> TrackShape:
        """Return the shape on another map."""
        lines = [
            replace(line, xy_cm=by.points(line.xy_cm), tangent=by.directions(line.tangent))
            for line in self.lines
        ]
        return TrackShape(
            self.name,
            self.lane_cm * by.scale,
            tuple(lines),
            by.points(self.path_cm),
            by.points(self.marks_cm),
            by.directions(self.mark_normals),
        )


def read_shape(folder: Path) -> TrackShape:
    """Read the shape of a map's longest segment.

    Raises:
        MapFormatError: If the folder is no map, or a file of it is damaged.
    """
    drive_map = read_map(folder)
    table = ParquetTable(folder / "edges.parquet")
    names = ("frame", "x_cm", "y_cm", "normal_x", "normal_y", "segment")
    edges = np.column_stack([np.asarray(table.floats(name)) for name in names])
    return shape_of(drive_map, edges, str(folder))


def longest_segment(drive_map: DriveMap) -> int:
    """Return the segment with most frames."""
    return int(np.bincount(drive_map.segment).argmax())


def shape_of(drive_map: DriveMap, edges: Float[np.ndarray, "m 6"], name: str) -> TrackShape:
    """Take the shape from a map.

    Args:
        drive_map: The map.
        edges: Its edge points: frame, x, y, normal (x, y), segment.
        name: For messages.
    """
    segment = longest_segment(drive_map)
    rows = drive_map.segment == segment
    poses, s_cm = drive_map.poses[rows], drive_map.s_cm[rows]
    lines = tuple(sample_line(line, s_cm) for line in drive_map.lines[segment])
    shape = TrackShape(
        name, drive_map.meta.mapped_lane_cm, lines, thinned(poses), np.empty((0, 2)), np.empty((0, 2))
    )
    edges = edges[edges[:, 5] == segment]
    marks_cm, normals = find_marks(shape, drive_map.frames[rows], poses, edges)
    return replace(shape, marks_cm=marks_cm, mark_normals=normals)


def sample_line(line: LaneLine, s_frames_cm: Float[np.ndarray, "n"]) -> SampledLine:
    """Sample a line evenly, as far as the frames drove along it."""
    low, high = line.span_cm
    if line.period_cm is None:
        low, high = max(low, float(s_frames_cm.min())), min(high, float(s_frames_cm.max()) + STEP_CM)
    fine_cm = np.linspace(low, high, max(int((high - low) / (0.25 * STEP_CM)), 2))
    along = path_lengths(line.everywhere(fine_cm))
    count = max(int(along[-1] / STEP_CM), 2)
    s_cm = np.interp(np.linspace(0.0, along[-1], count, endpoint=line.period_cm is None), along, fine_cm)
    tangent = line.everywhere(s_cm, 1)
    tangent /= np.maximum(np.hypot(*tangent.T), 1e-9)[:, None]
    known = line.supported(s_cm) & ~line.contradicted(s_cm)
    closed = line.period_cm is not None
    return SampledLine(
        line.index, line.everywhere(s_cm), tangent, known, closed, line.sigma_cm(s_cm), line.unpainted
    )


def thinned(poses: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "p 2"]:
    """Keep a pose every few centimetres."""
    cells = (path_lengths(poses) / _PATH_STEP_CM).astype(np.int64)
    return poses[np.unique(cells, return_index=True)[1], :2]


def find_marks(
    shape: TrackShape,
    frames: Int[np.ndarray, "n"],
    poses: Float[np.ndarray, "n 3"],
    edges: Float[np.ndarray, "m 6"],
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]:
    """Find places beside the lines where many frames saw an edge that faces the same way.

    Args:
        shape: The lines.
        frames: Frame numbers of the segment.
        poses: Their poses.
        edges: See :func:`shape_of`.

    Returns:
        Places, frame map, and unit normals to their brighter side.
    """
    if not len(edges):
        return np.empty((0, 2)), np.empty((0, 2))
    at = poses[np.searchsorted(frames, edges[:, 0].astype(np.int64)), :2]
    xy_cm, normals = edges[:, 1:3], edges[:, 3:5]
    near = np.hypot(*(xy_cm - at).T) < _MARK_LANES * shape.lane_cm
    apart, _ = shape.tree.query(xy_cm[near], distance_upper_bound=_OFF_LINE * shape.lane_cm)
    kept = np.flatnonzero(near)[~np.isfinite(apart)]
    way = np.floor(np.arctan2(normals[kept, 1], normals[kept, 0]) / (2.0 * np.pi / _WAYS)).astype(np.int64)
    cells = np.column_stack([np.floor(xy_cm[kept] / _CELL_CM).astype(np.int64), way])
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    if not len(cell):
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = np.unique(np.column_stack([cell, edges[kept, 0].astype(np.int64)]), axis=0)
    seen = np.bincount(pairs[:, 0], minlength=cell.max() + 1)
    counts = np.bincount(cell)
    means = [np.bincount(cell, v) / counts for v in (*xy_cm[kept].T, *normals[kept].T)]
    often = seen >= _LEAST_SEEN
    places, facing = np.stack(means[:2], axis=1)[often], np.stack(means[2:], axis=1)[often]
    return places, facing / np.maximum(np.hypot(*facing.T), 1e-9)[:, None]
