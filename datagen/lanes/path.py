"""Curvilinear coordinates along a path: s along it, d to its left; the path is open or one closed lap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.ndimage import gaussian_filter1d

from datagen.slam.odometry.scans import Scans
from lanenet.errors import TrackingLostError
from lanenet.geometry.poses import path_lengths

_SHORTEST_CM = 20.0


@dataclass(frozen=True)
class Path:
    """A smooth path, sampled evenly.

    Attributes:
        step_cm: Distance between samples.
        xy_cm: Samples, frame map.
        left: Unit vector to the left at each sample.
        s_frames_cm: Position of each frame's rear axle along the path.
        d_frames_cm: Offset of each frame's rear axle; None for a car on its path.
        forward: Which frames drive in the path's direction; None for all.
        closed: Whether the path is one lap, whose last sample comes a step before the first.
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
        """Length of a lap; None where the path is open."""
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
    def s_cm(self) -> Float[np.ndarray, "m"]:
        """Position of the samples along the path."""
        return np.arange(len(self.xy_cm)) * self.step_cm

    def points(self, d_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Return the point at offset d to the left of each sample, [cm], frame map."""
        return self.xy_cm + d_cm[:, None] * self.left


def path_of_poses(poses: Float[np.ndarray, "n 3"], step_cm: float, ahead_cm: float) -> Path:
    """Smooth a trajectory of rear-axle poses and sample it evenly.

    The path is carried on beyond the last pose with its last curvature, because the last frames see road
    that was never driven.

    Args:
        poses: Rear-axle poses, frame map.
        step_cm: Distance between samples.
        ahead_cm: Length to add at the end.

    Raises:
        TrackingLostError: If the car hardly moves.
    """
    smooth = gaussian_filter1d(poses[:, :2], 2.0, axis=0, mode="nearest")
    distance = path_lengths(smooth)
    # Standing still gives several frames at one place; interpolation needs a strictly growing argument.
    s = distance + np.arange(len(distance)) * 1e-6
    if s[-1] < max(_SHORTEST_CM, 3.0 * step_cm):
        raise TrackingLostError(
            f"the car moved {distance[-1]:.1f} cm in {len(poses)} frames, expected {_SHORTEST_CM:.0f} cm: "
            "there is no path to look for lines along"
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


@dataclass(frozen=True)
class PathEdges:
    """Edge points in the coordinates of a path.

    Attributes:
        s_cm: Position along the path.
        d_cm: Offset to the left.
        side: Component of the edge's normal (towards the brighter side) to the left, -1..1.
        along: Component of it along the path.
        weight: Trust in the point.
        distance_cm: How far from the front axle it was seen.
        frame: Frame that saw it.
    """

    s_cm: Float[np.ndarray, "m"]
    d_cm: Float[np.ndarray, "m"]
    side: Float[np.ndarray, "m"]
    along: Float[np.ndarray, "m"]
    weight: Float[np.ndarray, "m"]
    distance_cm: Float[np.ndarray, "m"]
    frame: Int[np.ndarray, "m"]

    def part(self, rows: Bool[np.ndarray, "m"]) -> PathEdges:
        """Return some of the points."""
        return PathEdges(
            self.s_cm[rows],
            self.d_cm[rows],
            self.side[rows],
            self.along[rows],
            self.weight[rows],
            self.distance_cm[rows],
            self.frame[rows],
        )


def edges_along_path(
    path: Path, scans: Scans, poses: Float[np.ndarray, "n 3"], wheelbase_cm: float, reach_cm: float
) -> PathEdges:
    """Express every frame's edge points in path coordinates.

    A point is looked for only on the stretch of path that its frame could see, so that neighbouring stretches
    never take it. On a closed path the edges of all laps and of both directions come to lie on one another.

    Args:
        path: The path of these poses.
        scans: Edge points per frame.
        poses: Rear-axle poses, frame map.
        wheelbase_cm: Distance between the axles.
        reach_cm: Edge points further than this from the front axle are left out.
    """
    distance = np.hypot(scans.points_cm[:, 0], scans.points_cm[:, 1])
    keep = distance <= reach_cm
    frame = scans.frame_of_point[keep]
    forward = path.drives_forward
    s, d, side, along = _project(
        path.xy_cm,
        path.left,
        path.step_cm,
        path.closed,
        path.s_frames_cm[frame],
        forward[frame],
        poses[frame],
        scans.points_cm[keep],
        scans.normals[keep],
        wheelbase_cm,
        reach_cm + 2.0 * wheelbase_cm,
    )
    good = np.isfinite(s)
    return PathEdges(
        s[good],
        d[good],
        side[good],
        along[good],
        scans.weights[keep][good],
        distance[keep][good],
        frame[good],
    )


def without_frames(scans: Scans, left_out: Bool[np.ndarray, "n"]) -> Scans:
    """Return the scans with some frames emptied; the others stay at their index."""
    kept = ~left_out[scans.frame_of_point]
    counts = np.where(left_out, 0, np.diff(scans.starts))
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Scans(scans.points_cm[kept], scans.normals[kept], scans.weights[kept], starts)


@njit(cache=True)
@no_type_check
def _project(xy, left, step, closed, s_frame, forward, pose, points, normals, wheelbase, span):
    n, m = points.shape[0], xy.shape[0]
    s_out, d_out = np.full(n, np.nan), np.zeros(n)
    side_out, along_out = np.zeros(n), np.zeros(n)
    for i in range(n):
        c, sn = np.cos(pose[i, 2]), np.sin(pose[i, 2])
        ahead, right = points[i, 1] + wheelbase, points[i, 0]
        x = pose[i, 0] + ahead * c + right * sn
        y = pose[i, 1] + ahead * sn - right * c
        here = int(s_frame[i] / step)
        reach = int(span / step)
        first, last = (here - 5, here + reach) if forward[i] else (here - reach, here + 5)
        if closed:
            last = min(last, first + m - 1)
        else:
            first, last = max(0, first), min(m - 1, last)
        best, nearest = 1e18, first
        for j in range(first, last + 1):
            distance = (xy[j % m, 0] - x) ** 2 + (xy[j % m, 1] - y) ** 2
            if distance < best:
                best, nearest = distance, j
        if nearest <= first or nearest >= last:
            continue
        nearest = nearest % m
        dx, dy = x - xy[nearest, 0], y - xy[nearest, 1]
        # The tangent is the left normal turned clockwise.
        along = dx * left[nearest, 1] - dy * left[nearest, 0]
        s_out[i] = nearest * step + along
        if closed:
            s_out[i] = s_out[i] % (m * step)
        d_out[i] = dx * left[nearest, 0] + dy * left[nearest, 1]
        nx = normals[i, 1] * c + normals[i, 0] * sn
        ny = normals[i, 1] * sn - normals[i, 0] * c
        side_out[i] = nx * left[nearest, 0] + ny * left[nearest, 1]
        along_out[i] = nx * left[nearest, 1] - ny * left[nearest, 0]
    return s_out, d_out, side_out, along_out
