"""The driven path, open or one closed lap, and curvilinear coordinates along it: s ahead, d to the left."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.lap import stitched_road, with_long_steps_filled
from datagen.slam.loops.consistency import of_one_lap
from datagen.slam.odometry.scans import Scans, distances_seen
from lanenet.errors import TrackingLostError
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import path_lengths

#: Shortest path along which lines are looked for. Chosen: about the length of one dash.
_SHORTEST_CM = 20.0
#: Cosine of the largest angle between a frame's heading and the road's, either way round: 60 degrees. Chosen:
#: cars that follow a lane stay below 30 degrees, roads that cross are at 90.
_MIN_COSINE = 0.5
#: A frame further than this from the lap, in camera heights, is on another road; a drive with a larger share
#: of such frames is no lap. Chosen: about the widest lane that is looked for (6.5 heights).
_OFF_HEIGHTS, _MAX_OFF = 6.0, 0.15
#: Smoothing of the lap. Chosen: removes the jitter of poses. A bend of 50 cm radius moves inwards by less
#: than 1 cm, which the offsets of the lines take up.
_SMOOTH_CM = 6.0

#: A value at each sample of a path, and a choice of samples.
Samples = Float[np.ndarray, "m"]
SampleMask = Bool[np.ndarray, "m"]


@dataclass(frozen=True)
class Path:
    """A smooth path with even samples.

    Attributes:
        step_cm: Distance between samples.
        xy_cm: Samples, frame map.
        left: Unit vector to the left at each sample.
        s_frames_cm: Position of each frame's rear axle along the path.
        d_frames_cm: Offset of each frame's rear axle; None for zero.
        forward: Which frames drive in the path's direction; None for all.
        closed: Whether the path is one lap, with its last sample one step before the first.
    """

    step_cm: float
    xy_cm: Float[np.ndarray, "m 2"]
    left: Float[np.ndarray, "m 2"]
    s_frames_cm: Float[np.ndarray, "n"]
    d_frames_cm: Float[np.ndarray, "n"] | None = None
    forward: Bool[np.ndarray, "n"] | None = None
    closed: bool = False

    @property
    def period_cm(self) -> float | None:
        """Length of the lap; None for an open path."""
        return len(self.xy_cm) * self.step_cm if self.closed else None

    @property
    def offsets_cm(self) -> Float[np.ndarray, "n"]:
        """Offset of each frame's rear axle."""
        return np.zeros(len(self.s_frames_cm)) if self.d_frames_cm is None else self.d_frames_cm

    @property
    def drives_forward(self) -> Bool[np.ndarray, "n"]:
        """Whether each frame drives in the path's direction."""
        return np.ones(len(self.s_frames_cm), dtype=bool) if self.forward is None else self.forward

    @property
    def s_cm(self) -> Samples:
        """Position of the samples along the path."""
        return np.arange(len(self.xy_cm)) * self.step_cm

    def points(self, d_cm: Samples) -> Float[np.ndarray, "m 2"]:
        """Return the point at offset d to the left of each sample, [cm], frame map."""
        return self.xy_cm + d_cm[:, None] * self.left


def path_of_poses(poses: Float[np.ndarray, "n 3"], step_cm: float, ahead_cm: float) -> Path:
    """Smooth a trajectory and sample it evenly.

    The path is extended beyond the last pose at its last curvature, because the last frames see road that was
    not driven.

    Args:
        poses: Rear-axle poses, frame map.
        step_cm: Distance between samples.
        ahead_cm: Length to add at the end.

    Raises:
        TrackingLostError: If the car hardly moves.
    """
    smooth = gaussian_filter1d(poses[:, :2], 2.0, axis=0, mode="nearest")
    distance = path_lengths(smooth)
    # Interpolation needs strictly increasing positions, also where the car stands still.
    s = distance + np.arange(len(distance)) * 1e-6
    if s[-1] < max(_SHORTEST_CM, 3.0 * step_cm):
        raise TrackingLostError(
            f"the car moved {distance[-1]:.1f} cm in {len(poses)} frames, expected {_SHORTEST_CM:.0f} cm: "
            "no path along which to look for lines"
        )
    samples = np.arange(0.0, s[-1], step_cm)
    xy = np.stack([np.interp(samples, s, smooth[:, i]) for i in range(2)], axis=1)
    tail = min(len(xy) - 1, max(2, int(20.0 / step_cm)))
    direction = np.unwrap(np.arctan2(*np.diff(xy[-tail - 1 :], axis=0).T[::-1]))
    curvature = (direction[-1] - direction[0]) / max((len(direction) - 1) * step_cm, step_cm)
    extra = np.arange(1, int(ahead_cm / step_cm) + 1) * step_cm
    heading = direction[-1] + curvature * extra
    added = xy[-1] + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1) * step_cm, axis=0)
    xy = np.concatenate([xy, added])
    xy = gaussian_filter1d(xy, max(1.0, 4.0 / step_cm), axis=0, mode="nearest")
    return Path(step_cm, xy, left_of(np.gradient(xy, axis=0)), s)


def left_of(direction: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Unit vectors to the left of directions of any length."""
    unit = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return np.stack([-unit[:, 1], unit[:, 0]], axis=1)


def shared_path(
    poses: Float[np.ndarray, "n 3"],
    part: Int[np.ndarray, "n"],
    revisits: list[tuple[int, int]],
    step_cm: float,
    ahead_cm: float,
    camera_height_cm: float,
    lead_cm: float = 0.0,
) -> Path | None:
    """Find the path that all visits share, one lap as a rule, and the position of every frame on it.

    The lap is the section between the two visits of one place that are closest together. Where no part of the
    drive holds a whole one, it is put together from several, or an open road is. What a lap misses of itself
    is distributed over it.

    Args:
        poses: Rear-axle poses after closing loops, frame map.
        part: Part of the drive that each frame belongs to.
        revisits: Pairs of frames, earlier and later, that show the same place in the same direction, both in
            one part.
        step_cm: Approximate distance between samples.
        ahead_cm: Length to add at the end of an open road.
        camera_height_cm: Sets the scale of bounds.
        lead_cm: Distance ahead of the rear axle of the point whose path it is. The axle of a long car cuts
            corners, up to over the line on the inside, while what its camera sees stays in the lane.

    Returns:
        The path, closed where it is a lap; None if the visits share none: the drive is in one part without a
        revisit, or too many frames lie elsewhere.
    """
    led = poses.copy()
    led[:, :2] += lead_cm * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    ends = _ends_of_lap(led, revisits)
    if ends is not None:
        road, closed = led[ends[0] : ends[1] + 1], True
    elif part[-1] > part[0]:
        road, closed = stitched_road(led, part, camera_height_cm)
    else:
        return None
    road = with_long_steps_filled(road, camera_height_cm)
    path = _closed_path(road[:, :2], step_cm) if closed else path_of_poses(road, step_cm, ahead_cm)
    s, d, forward = positions_on_path(path, poses, part)
    if np.mean(np.abs(d) > _OFF_HEIGHTS * camera_height_cm) > _MAX_OFF:
        return None
    return replace(path, s_frames_cm=s, d_frames_cm=d, forward=forward)


def _closed_path(xy: Float[np.ndarray, "k 2"], step_cm: float) -> Path:
    """Close a lap, smooth it and sample it evenly."""
    along = path_lengths(xy)
    xy = xy - (along / along[-1])[:, None] * (xy[-1] - xy[0])
    xy = _even(xy, step_cm)
    for _ in range(2):
        # Smoothing shortens bends, so the samples are made even again.
        spacing = float(np.linalg.norm(np.diff(xy, axis=0, append=xy[:1]), axis=1).mean())
        xy = gaussian_filter1d(xy, _SMOOTH_CM / spacing, axis=0, mode="wrap")
        xy = _even(np.concatenate([xy, xy[:1]]), step_cm)
    step = float(np.linalg.norm(np.diff(xy, axis=0, append=xy[:1]), axis=1).mean())
    return Path(step, xy, left_of(np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)), np.empty(0), closed=True)


def positions_on_path(
    path: Path, poses: Float[np.ndarray, "n 3"], part: Int[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Find each pose's position along a path, its offset to the left, and whether it drives forward.

    Where roads cross or lie side by side, heading and the position of the frame before in its part decide.
    """
    n, s_all = len(poses), path.s_cm
    # On an open path no position comes again.
    period = path.period_cm or 4.0 * len(path.xy_cm) * path.step_cm
    road = np.arctan2(-path.left[:, 0], path.left[:, 1])
    s, d, forward = np.empty(n), np.empty(n), np.ones(n, dtype=bool)
    moved = np.concatenate([[0.0], np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)])
    expected: float | None = None
    for k in range(n):
        apart = poses[k, :2] - path.xy_cm
        cosine = np.cos(poses[k, 2] - road)
        cost = np.linalg.norm(apart, axis=1)
        if expected is not None:
            miss = np.abs(np.mod(s_all - expected + 0.5 * period, period) - 0.5 * period)
            # Bounded by about the width of a road, so that a wrong position is left again.
            cost = cost + np.minimum(0.5 * miss, 30.0)
        cost = cost + np.where(np.abs(cosine) < _MIN_COSINE, 1e6, 0.0)
        i = int(np.argmin(cost))
        along = float(apart[i] @ [path.left[i, 1], -path.left[i, 0]])
        s[k] = s_all[i] + np.clip(along, -path.step_cm, path.step_cm)
        s[k] = np.mod(s[k], period) if path.closed else max(s[k], 0.0)
        d[k] = float(apart[i] @ path.left[i])
        forward[k] = bool(cosine[i] > 0.0)
        expected = None
        if k + 1 < n and part[k + 1] == part[k]:
            expected = s[k] + (moved[k + 1] if forward[k] else -moved[k + 1])
    return s, d, forward


def _ends_of_lap(poses: Float[np.ndarray, "n 3"], revisits: list[tuple[int, int]]) -> tuple[int, int] | None:
    """Find the two frames one lap apart that are closest together."""
    if not revisits:
        return None
    path = path_lengths(poses)
    pairs = np.array(revisits)
    gaps = path[pairs[:, 1]] - path[pairs[:, 0]]
    pairs = pairs[of_one_lap(gaps)]
    step = poses[pairs[:, 1]] - poses[pairs[:, 0]]
    turn = np.abs(wrap_angle(step[:, 2]))
    apart = np.linalg.norm(step[:, :2], axis=1) * (1.0 + turn)
    first, last = (int(k) for k in pairs[int(np.argmin(np.where(turn < np.pi / 3.0, apart, np.inf)))])
    # Of the frames around the second visit, the one nearest to the first frame along the road.
    near = np.arange(max(first + 2, last - 20), min(len(poses), last + 21))
    ahead = np.stack([np.cos(poses[first, 2]), np.sin(poses[first, 2])])
    last = int(near[int(np.argmin(np.abs((poses[near, :2] - poses[first, :2]) @ ahead)))])
    closed = path[last] - path[first]
    missed = float(np.linalg.norm(poses[last, :2] - poses[first, :2]))
    return None if missed > 0.1 * closed else (first, last)


def _even(xy: Float[np.ndarray, "m 2"], step_cm: float) -> Float[np.ndarray, "k 2"]:
    """Sample a closed polygon, whose last point repeats the first, evenly."""
    along = path_lengths(xy) + 1e-6 * np.arange(len(xy))
    samples = np.linspace(0.0, along[-1], max(8, round(along[-1] / step_cm)) + 1)[:-1]
    return np.stack([np.interp(samples, along, xy[:, i]) for i in range(2)], axis=1)


@dataclass(frozen=True)
class PathEdges:
    """Edge points in the coordinates of a path.

    Attributes:
        s_cm: Position along the path.
        d_cm: Offset to the left.
        side: Component to the left of the edge's unit normal, which points to the brighter side; see
            :meth:`towards_dark`.
        along: Component of the normal along the path.
        weight: Weight of the point.
        distance_cm: Distance at which it was seen, see :func:`distances_seen`.
        frame: Frame that saw it.
    """

    s_cm: Float[np.ndarray, "m"]
    d_cm: Float[np.ndarray, "m"]
    side: Float[np.ndarray, "m"]
    along: Float[np.ndarray, "m"]
    weight: Float[np.ndarray, "m"]
    distance_cm: Float[np.ndarray, "m"]
    frame: Int[np.ndarray, "m"]

    def select(self, rows: Bool[np.ndarray, "m"]) -> PathEdges:
        """Return some of the points."""
        return PathEdges(*(getattr(self, item.name)[rows] for item in fields(self)))

    def towards_dark(self) -> PathEdges:
        """Return the points with normals to the darker side: dark markings look like bright ones."""
        return replace(self, side=-self.side, along=-self.along)


@dataclass(frozen=True)
class MapEdges:
    """Edge points on the map.

    Attributes:
        xy_cm: Places, frame map.
        normals: Unit normals, towards the brighter side.
        frame: Frame that saw each.
        row: Position of the point in the scans.
        distance_cm: Distance at which it was seen, see :func:`distances_seen`.
    """

    xy_cm: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]
    frame: Int[np.ndarray, "m"]
    row: Int[np.ndarray, "m"]
    distance_cm: Float[np.ndarray, "m"]

    def select(self, rows: Bool[np.ndarray, "m"]) -> MapEdges:
        """Return some of the points."""
        return MapEdges(*(getattr(self, item.name)[rows] for item in fields(self)))

    def towards_dark(self) -> MapEdges:
        """Return the points with normals to the darker side, as :meth:`PathEdges.towards_dark`."""
        return replace(self, normals=-self.normals)


def edges_on_map(
    scans: Scans, poses: Float[np.ndarray, "n 3"], wheelbase_cm: float, reach_cm: float, lead_cm: float = 0.0
) -> MapEdges:
    """Move every frame's edge points up to a distance, see :func:`distances_seen`, to the map."""
    distance = distances_seen(scans.points_cm, lead_cm)
    keep = distance <= reach_cm
    frame = scans.frame_of_point[keep]
    ahead = np.stack([np.cos(poses[frame, 2]), np.sin(poses[frame, 2])], axis=1)
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    points, normals = (
        car[keep, 1:] * ahead + car[keep, :1] * right
        for car in (scans.points_cm + [0.0, wheelbase_cm], scans.normals)
    )
    return MapEdges(points + poses[frame, :2], normals, frame, np.flatnonzero(keep), distance[keep])


def edges_along_path(
    path: Path,
    scans: Scans,
    poses: Float[np.ndarray, "n 3"],
    wheelbase_cm: float,
    reach_cm: float,
    lead_cm: float = 0.0,
) -> PathEdges:
    """Express every frame's edge points in path coordinates.

    A point is assigned only to the section of the path that its frame could see, never to a section of road
    beside it. On a closed path, the edges of all laps and both directions coincide.

    Args:
        path: The path, with the frames' positions.
        scans: Edge points per frame.
        poses: Rear-axle poses, frame map.
        wheelbase_cm: Distance between the axles.
        reach_cm: Largest distance of edge points, see :func:`distances_seen`.
        lead_cm: Of the camera, see :attr:`lanenet.geometry.camera.Mounting.lead_cm`.
    """
    edges = edges_on_map(scans, poses, wheelbase_cm, reach_cm, lead_cm)
    span_cm = reach_cm + 2.0 * wheelbase_cm + lead_cm
    forward = path.drives_forward[edges.frame]
    row = _nearest_rows(
        path.xy_cm, path.step_cm, path.closed, path.s_frames_cm[edges.frame], forward, edges.xy_cm, span_cm
    )
    seen = row >= 0
    row, normals, off = row[seen], edges.normals[seen], edges.xy_cm[seen] - path.xy_cm[row[seen]]
    left = path.left[row]
    # The tangent is the left normal rotated clockwise by 90 degrees.
    tangent = np.stack([left[:, 1], -left[:, 0]], axis=1)
    s = row * path.step_cm + np.sum(off * tangent, axis=1)
    return PathEdges(
        s_cm=s if path.period_cm is None else np.mod(s, path.period_cm),
        d_cm=np.sum(off * left, axis=1),
        side=np.sum(normals * left, axis=1),
        along=np.sum(normals * tangent, axis=1),
        weight=scans.weights[edges.row[seen]],
        distance_cm=edges.distance_cm[seen],
        frame=edges.frame[seen],
    )


def without_frames(scans: Scans, left_out: Bool[np.ndarray, "n"]) -> Scans:
    """Return the scans with some frames emptied; frames keep their index."""
    kept = ~left_out[scans.frame_of_point]
    counts = np.where(left_out, 0, np.diff(scans.starts))
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Scans(scans.points_cm[kept], scans.normals[kept], scans.weights[kept], starts)


@njit(cache=True)
@no_type_check
def _nearest_rows(xy, step, closed, s_frame, forward, points, span):
    """Nearest path sample of each point, within what its frame could see; -1 where that is none.

    Args:
        xy: Path samples.
        step: Distance between samples.
        closed: Whether the path is a loop.
        s_frame: Position along the path of each point's frame.
        forward: Whether that frame drives along the path's direction.
        points: Points, frame map.
        span: How far along the path a frame sees.
    """
    m, reach = len(xy), int(span / step)
    rows = np.full(len(points), -1)
    for i in range(len(points)):
        here = int(s_frame[i] / step)
        first, last = (here - 5, here + reach) if forward[i] else (here - reach, here + 5)
        if closed:
            last = min(last, first + m - 1)
        else:
            first, last = max(0, first), min(m - 1, last)
        best, nearest = 1e18, first
        for j in range(first, last + 1):
            distance = (xy[j % m, 0] - points[i, 0]) ** 2 + (xy[j % m, 1] - points[i, 1]) ** 2
            if distance < best:
                best, nearest = distance, j
        if first < nearest < last:
            rows[i] = nearest % m
    return rows
