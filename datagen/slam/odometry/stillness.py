"""What stands still: the car, so that its frames are left out, or what a lamp mirrors in the floor.

Frames in which the car stands or reverses are left out, and breaks that only the images show are marked.

The mirror image of a lamp lies as far below the floor as the lamp hangs above it. It hardly moves while the
road runs by, and only turns with the car. To the odometry its rim says that the car stands, and on a road
without dashes nothing contradicts. A line along the road stands still in the same way, but it goes on
straight where a rim bends away. The side of a dash, or of anything else along the road, stands still without
saying anything about the motion.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from datagen.slam.commands import GAP_PERIODS
from datagen.slam.odometry.edge_motion import edges_moved
from lanenet.data.drives import Commands, Drive
from lanenet.data.segments import true_runs
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import to_gray
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadEdges, RoadTable

#: Size of a small image: patches of 6 to 7 px of an image of 160 x 120.
SMALL_WIDTH, SMALL_HEIGHT = 24, 18
#: Frames over which the image of a moving car changes: half a second at 20 Hz.
_AHEAD = 10
#: Gray levels; averaged over such large patches, the noise of any camera is below it.
_NOISE = 0.6
#: Share of a drive's typical change below which two images count as the same. Chosen: a car at a quarter of
#: its typical speed may still be tracked.
_STILL_SHARE = 0.25
#: Correlation of neighbouring images below which the second shows another place, and how much higher the
#: correlations before and after it are. Chosen: in a quick turn neighbours correlate little too, but all of
#: them do.
_ELSEWHERE, _DIP = 0.35, 0.35
#: Contrast of an image as a share of that of the drive's median one, below which it is too bare to tell one
#: place from another. Chosen: 95 % of the images of ``usi_mat``, ``garage_tape`` and ``donkey_circuit`` stay
#: above 0.8; those of a bare sheet in ``blue_tape``, in which one line is all that there is, lie about 0.5.
_BARE = 2.0 / 3.0
#: Throttle below which Donkeycar's car brakes or reverses; above, it is the noise of a joystick.
_BACKWARDS_THROTTLE = -0.05
#: Moving frames of a reverse command that count as reversing: a driver who brakes needs fewer.
_BACKING = 5
#: Change below which not even the noise differs: the frame was recorded twice.
_EPSILON = 1e-9
#: A crawl changes over ten frames by more than this times the change from one to the next; noise, and an
#: exposure that drifts, change by less. Chosen.
_GOES_ON = 3.0
#: Frames that a live car looks back, and moving frames whose median change is its typical one.
_BACK, _WATCHED = 4, 300
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
#: Frames in a row that show the same while the car drives on: an image that was written again. Chosen: more
#: are a stop.
_MOST_REPEATS = 2
#: Cells of the road, in camera heights, in which the continuation of an edge is looked for, and directions
#: told apart; size of this grid in cells: 9 camera heights ahead, 6 to either side.
_CELL_HEIGHTS, _SECTORS = 0.05, 8
_AHEAD_CELLS, _SIDE_CELLS = 180, 120
#: Places along a straight edge where it must go on, in camera heights: the rim of a mirrored lamp is smaller.
_ON_STRAIGHT_HEIGHTS = (0.2, 0.4, 0.6, 0.8)
#: Edges this near to a standing one, and on no straight one, belong to it: 0.2 camera heights.
_NEAR_CELLS = 4


def following_frames(drive: Drive) -> tuple[Drive, list[str]]:
    """Leave out frames in which the car stands or reverses, and mark breaks that only the images show.

    All later stages follow a car that drives forward; where it reverses, the drive breaks.

    Returns:
        The drive that is left, and notes on what was found, a sentence each.

    Raises:
        TrackingLostError: If the car was commanded to reverse all the time.
    """
    notes: list[str] = []
    small = small_images(drive)
    standing, elsewhere = standing_frames(small), put_elsewhere(small)
    for k in np.flatnonzero(standing).tolist():
        # On a bare floor the mean change says little.
        standing[k] = not edges_moved(drive.image(k - 1), drive.image(k))
    step_s = np.diff(drive.t_s, prepend=drive.t_s[:1])
    # Across a gap of the recording another image is no surprise.
    elsewhere &= step_s < GAP_PERIODS * np.median(step_s[1:])
    stood = np.zeros(len(drive), dtype=bool)
    for run in true_runs(standing):
        # A recorder that writes an image twice has missed one of a car that drives on.
        stood[run] = len(run) > _MOST_REPEATS
    drive = replace(drive, standing_s=np.cumsum(np.where(stood, step_s, 0.0)))
    if elsewhere.any():
        where = ", ".join(str(number) for number in drive.frames[elsewhere][:5])
        notes.append(f"{elsewhere.sum()} breaks in the images, the first before frame {where}")
    breaks = drive.breaks | elsewhere
    backing = reversing_runs(drive.commands, standing)
    backs_up = np.zeros(len(drive), dtype=bool)
    for start, stop in backing:
        backs_up[start:stop] = True
        breaks[stop : stop + 1] = True
    if backing:
        where = ", ".join(f"{drive.frames[start]}-{drive.frames[stop - 1]}" for start, stop in backing[:5])
        more = f" and {len(backing) - 5} times more" if len(backing) > 5 else ""
        notes.append(f"the car was commanded to reverse in frames {where}{more}: left out")
        if (standing | backs_up).all():
            raise TrackingLostError(
                f"{drive.path}: the car was commanded to reverse in frames {where}{more} and stands in "
                "all others, expected a car that drives forward"
            )
    same = standing & ~backs_up
    if same.any():
        notes.append(f"{same.sum()} frames show the same as the one before, and are left out")
    drive, left_out = replace(drive, breaks=breaks), standing | backs_up
    return (drive.subset(np.flatnonzero(~left_out)) if left_out.any() else drive), notes


def reversing_runs(commands: Commands, standing: Bool[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Find where the car was commanded to reverse, and moved for several frames.

    The throttle is used only if no speed was recorded and it is mostly positive: the motor may run the other
    way round.

    Args:
        commands: The commands.
        standing: See :func:`standing_frames`.

    Returns:
        First row of each run, and the row after its last.
    """
    reverse = np.zeros(len(standing), dtype=bool)
    if commands.speed_cm_s is not None:
        reverse = commands.speed_cm_s < 0.0
    elif commands.throttle is not None and np.sum(commands.throttle > 0.0) > np.sum(commands.throttle < 0.0):
        reverse = commands.throttle < _BACKWARDS_THROTTLE
    bounds = np.flatnonzero(np.diff(reverse.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in bounds if (~standing[a:b]).sum() >= _BACKING]


def small_images(drive: Drive) -> Float32[np.ndarray, "n h w"]:
    """Return every frame as :func:`shrink_image` does."""
    small = np.empty((len(drive), SMALL_HEIGHT, SMALL_WIDTH), np.float32)
    for k in range(len(drive)):
        small[k] = shrink_image(drive.image(k))
    return small


def shrink_image(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Return an image in gray, averaged over large patches."""
    size = (SMALL_WIDTH, SMALL_HEIGHT)
    return np.asarray(cv2.resize(to_gray(image), size, interpolation=cv2.INTER_AREA))


def standing_frames(small: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Find the frames that show the same as those before them: repeated ones, and those of a car that stands.

    Such an image hardly differs from the one before it, nor from the one ten frames before or after. "Hardly"
    is relative to the change in ten frames that is typical of this drive while the car moves. A crawl changes
    little from frame to frame, but goes on. The first frame of a stop is kept.

    Args:
        small: See :func:`small_images`.
    """
    n = len(small)
    flat = small.reshape(n, -1)
    # A lamp that flickers, or an exposure that drifts, is no motion.
    flat = flat - flat.mean(axis=1, keepdims=True)
    standing = np.zeros(n, dtype=bool)
    if n <= _AHEAD:
        return standing
    step = _change(flat, 1)
    far = _change(flat, _AHEAD)
    limit = max(_NOISE, _STILL_SHARE * _typical_change(step, far))
    # At either end of a stop, the change before the frame or the one after it is large.
    before = np.concatenate([np.full(_AHEAD, np.inf), far])
    after = np.concatenate([far, np.full(_AHEAD, np.inf)])
    still = np.minimum(before, after) < limit
    standing[1:] = still[1:] & (step < limit)
    # Recorded twice.
    standing[1:] |= step < _EPSILON
    return standing


def _typical_change(step: Float[np.ndarray, "m"], far: Float[np.ndarray, "f"]) -> float:
    """Median change in ten frames of a car that moves.

    Args:
        step: Change of each image to the next.
        far: Change of each image to the one ten frames later.
    """
    so_far = np.concatenate([[0.0], np.cumsum(step)])
    near = (so_far[_AHEAD:] - so_far[:-_AHEAD]) / _AHEAD
    # Noise is as large between any two images.
    moves = (near > _NOISE) | (far > _GOES_ON * near)
    return float(np.median(far[moves])) if moves.any() else 0.0


class StandstillDetector:
    """Says of each frame as it comes whether the car stands.

    As :func:`standing_frames`, but from past frames alone: the first frames of a stop count as driven, and
    the typical change is that of the last moving frames.
    """

    def __init__(self) -> None:
        self._last: deque[Float32[np.ndarray, "d"]] = deque(maxlen=_BACK)
        self._changes: deque[float] = deque(maxlen=_WATCHED)

    def stands(self, small: UInt8[np.ndarray, "h w"]) -> bool:
        """Take in the next frame's small image (see :func:`shrink_image`)."""
        flat = small.astype(np.float32).ravel()
        flat -= flat.mean()
        full = len(self._last) == _BACK
        step = float(np.abs(flat - self._last[-1]).mean()) if self._last else np.inf
        far = float(np.abs(flat - self._last[0]).mean()) if full else np.inf
        self._last.append(flat)
        limit = max(_NOISE, _STILL_SHARE * float(np.median(self._changes))) if self._changes else _NOISE
        stands = step < _EPSILON or (far < limit and step < limit)
        if full and not stands:
            self._changes.append(far)
        return stands


def put_elsewhere(small: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Find frames that show another place than the one before: frames are missing, or somebody moved the car.

    Between two images of which one is bare, nothing is found.

    Args:
        small: See :func:`small_images`.
    """
    flat = small.reshape(len(small), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    contrast = np.linalg.norm(flat, axis=1, keepdims=True)
    unit = flat / np.maximum(contrast, 1.0)
    elsewhere = np.zeros(len(small), dtype=bool)
    alike = np.sum(unit[1:] * unit[:-1], axis=1)
    # In a quick turn many neighbours differ; a break is a single one between two that agree.
    around = np.minimum(alike[:-2], alike[2:])
    bare = contrast[:, 0] < _BARE * np.median(contrast)
    differs = (alike < _ELSEWHERE) & ~(bare[1:] | bare[:-1])
    elsewhere[2:-1] = differs[1:-1] & (around > alike[1:-1] + _DIP)
    return elsewhere


def _change(flat: Float[np.ndarray, "n d"], frames: int) -> Float[np.ndarray, "m"]:
    """Mean change of each image to the one so many frames later, [gray levels]."""
    return np.abs(flat[frames:] - flat[:-frames]).mean(axis=1)


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
        Own method; tests/unit/slam/test_stillness.py.
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
    grid = np.zeros((_AHEAD_CELLS + 2, 2 * _SIDE_CELLS + 2), np.uint8)
    row, column = _road_cells(view.points)
    grid[row[stands], column[stands]] = 1
    near = cv2.dilate(grid, np.ones((2 * _NEAR_CELLS + 1, 2 * _NEAR_CELLS + 1), np.uint8))
    return near[row, column] > 0
