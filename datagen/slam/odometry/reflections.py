"""Edges of lamps that are mirrored in the floor: they stand still before the car and would slow the odometry.

The mirror image of a lamp lies as far below the floor as the lamp hangs above it. It hardly moves while the
road runs by, and only turns with the car. To the odometry its rim says that the car stands, and on a road
without dashes nothing contradicts. A line along the road stands still in the same way, but it goes on
straight where a rim bends away. The side of a dash, or of anything else along the road, stands still without
saying anything about the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgePixels
from lanenet.perception.edges.road import RoadEdges, RoadTable

#: Cells of distance and bearing about the camera's foot, in camera heights and radians, and how many of them:
#: 4 camera heights, and 1.6 rad to either side. Chosen: a cell is about what noise moves an edge by.
_RING_HEIGHTS, _RINGS = 0.05, 80
_BEARING_RAD, _BEARINGS = 0.04, 80
#: Largest turn of the car from one frame to the next, in cells of bearing: 0.12 rad.
_TURN_CELLS = 3
#: Frames for which an edge keeps its distance before it counts as standing still. Chosen: a car that is not
#: crawling has driven a camera height by then.
_LIFE = 8
#: An edge faces the camera, or away from it, if the components of its normal along the ray and along the
#: car's path are at least this. With the former alone, dashes beside the car were taken for lamps, since
#: their sides face the camera from there; the ends of the dashes, which tell the distance best, went with
#: them. Chosen: 53 degrees.
_FACING = 0.6
#: Frames by which a frame without the edge reduces its count. A place beside a row of dashes sees a dash,
#: then a gap, and must not reach the count. Chosen.
_MISSED = 2
#: Cells of the road, in camera heights, in which the continuation of an edge is looked for, and directions
#: told apart; size of this grid in cells: 9 camera heights ahead, 6 to either side.
_CELL_HEIGHTS, _SECTORS = 0.05, 8
_AHEAD_CELLS, _SIDE_CELLS = 180, 120
#: Places along a straight edge where it must go on, in camera heights: the rim of a mirrored lamp is smaller.
_ON_STRAIGHT_HEIGHTS = (0.2, 0.4, 0.6, 0.8)
#: Edges this near to a standing one, and on no straight one, belong to it: 0.2 camera heights.
_NEAR_CELLS = 4


@dataclass(frozen=True)
class _View:
    """Edges of a frame as the camera's foot sees them; lengths in camera heights.

    Attributes:
        points: Right and ahead of the foot.
        normals: Towards the brighter side.
        cell: Ring and bearing of each point, clipped to the grid.
        side: 0 where the brighter side is the farther one, 1 where the nearer one is.
        faces: True for points inside the grid whose normal is along the ray and along the path.
    """

    points: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]
    cell: Int[np.ndarray, "n 2"]
    side: Int[np.ndarray, "n"]
    faces: Bool[np.ndarray, "n"]


def without_reflections(edges: Sequence[EdgePixels], camera: Camera, table: RoadTable) -> list[EdgePixels]:
    """Drop the edges of what stands still before the car, frame by frame.

    While a car stands it also loses edges across the road, which it does not need then.

    Args:
        edges: Edge pixels of consecutive frames.
        camera: The camera, or a coarse guess of it.
        table: Its table, with which the edges were found.

    Source:
        Own method; tests/unit/slam/test_reflections.py.
    """
    views = [_view(table.lift(frame), camera) for frame in edges]
    before = _lives(views)
    after = _lives(views[::-1])[::-1]
    kept = []
    for k, (frame, view) in enumerate(zip(edges, views, strict=True)):
        ring, bearing = view.cell.T
        life = before[k][ring, bearing, view.side].astype(np.int64) + after[k][ring, bearing, view.side] - 1
        stands = view.faces & (life >= _LIFE)
        if stands.any():
            goes_on = _goes_on(view)
            stands = _with_neighbours(view, stands & ~goes_on) & ~goes_on
        kept.append(EdgePixels(frame.uv_px[~stands], frame.normals[~stands]))
    return kept


def _view(road: RoadEdges, camera: Camera) -> _View:
    m = camera.mounting
    foot_cm = np.array([m.right_of_centre_cm, m.ahead_of_front_axle_cm])
    points = (road.points_cm - foot_cm) / m.height_cm
    distance = np.hypot(points[:, 0], points[:, 1])
    ring = np.floor(distance / _RING_HEIGHTS).astype(np.int64)
    bearing = (
        np.floor(np.arctan2(points[:, 0], points[:, 1]) / _BEARING_RAD).astype(np.int64) + _BEARINGS // 2
    )
    along = np.sum(points * road.normals, axis=1) / np.maximum(distance, 1e-9)
    inside = (ring < _RINGS) & (bearing >= 0) & (bearing < _BEARINGS)
    cell = np.stack([np.clip(ring, 0, _RINGS - 1), np.clip(bearing, 0, _BEARINGS - 1)], axis=1)
    faces = inside & (np.abs(along) > _FACING) & (np.abs(road.normals[:, 1]) > _FACING)
    return _View(points, road.normals, cell, (along < 0.0).astype(np.int64), faces)


def _lives(views: Sequence[_View]) -> list[UInt8[np.ndarray, "r b 2"]]:
    """For how many frames, up to each frame, a facing edge has kept its distance, however the car turned.

    One frame in which it was not found only reduces the count.
    """
    turn = np.ones((1, 2 * _TURN_CELLS + 1), np.uint8)
    thick = np.ones((3, 1), np.uint8)
    lives: list[np.ndarray] = []
    last = one_before = np.zeros((_RINGS, _BEARINGS, 2), np.uint8)
    missed = np.full_like(last, _MISSED)
    for view in views:
        there = np.zeros((_RINGS, _BEARINGS, 2), np.uint8)
        ring, bearing = view.cell[view.faces].T
        there[ring, bearing, view.side[view.faces]] = 1
        known = cv2.dilate(np.maximum(last, cv2.dilate(cv2.subtract(one_before, missed), turn)), turn)
        life = cv2.dilate(there, thick) * np.minimum(known + 1, _LIFE)
        lives.append(life)
        last, one_before = life, last
    return lives


def _goes_on(view: _View) -> Bool[np.ndarray, "n"]:
    """True for points from which their edge goes on straight, to both sides or far to one."""
    angle = np.arctan2(view.normals[:, 1], view.normals[:, 0])
    sector = np.floor(angle * (_SECTORS / (2.0 * np.pi))).astype(np.int64) % _SECTORS
    grid = np.zeros((_AHEAD_CELLS + 2, 2 * _SIDE_CELLS + 2), np.uint8)
    row, column = _road_cells(view.points)
    bits = (1 << sector) | (1 << (sector + 1) % _SECTORS) | (1 << (sector - 1) % _SECTORS)
    np.bitwise_or.at(grid, (row, column), bits.astype(np.uint8))
    # An edge is also found from the cells around its own.
    for cells in (grid, grid.T):
        beside = cells.copy()
        cells[1:] |= beside[:-1]
        cells[:-1] |= beside[1:]
    tangent = np.stack([-view.normals[:, 1], view.normals[:, 0]], axis=1)
    own = (1 << sector).astype(np.uint8)
    reach = np.array(_ON_STRAIGHT_HEIGHTS)
    offsets = np.stack([-reach, reach])[..., None, None] * tangent
    # By side, distance and point.
    found = grid[_road_cells(view.points + offsets)] & own > 0
    return found[:, :2].all(axis=(0, 1)) | found.all(axis=1).any(axis=0)


def _road_cells(points: Float[np.ndarray, "*k 2"]) -> tuple[Int[np.ndarray, "*k"], Int[np.ndarray, "*k"]]:
    """Row and column of road points; points outside the grid fall on its border.

    An edge that leads out of the grid, to the car or to the side, may go on there: the border says so if it
    holds an edge of that direction.
    """
    column = np.floor(points[..., 0] / _CELL_HEIGHTS).astype(np.int64) + _SIDE_CELLS + 1
    row = np.floor(points[..., 1] / _CELL_HEIGHTS).astype(np.int64) + 1
    return np.clip(row, 0, _AHEAD_CELLS + 1), np.clip(column, 0, 2 * _SIDE_CELLS + 1)


def _with_neighbours(view: _View, stands: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Add all points beside those that stand still."""
    if not stands.any():
        return stands
    grid = np.zeros((_AHEAD_CELLS + 2, 2 * _SIDE_CELLS + 2), np.uint8)
    row, column = _road_cells(view.points)
    grid[row[stands], column[stands]] = 1
    near = cv2.dilate(grid, np.ones((2 * _NEAR_CELLS + 1, 2 * _NEAR_CELLS + 1), np.uint8))
    return near[row, column] > 0
