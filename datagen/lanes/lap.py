"""The road of a drive that was recorded in parts: one lap, or one way along an open road.

Where no part holds all of it, it is put together: it follows a part to its end and goes on with another visit
of the same place, until it comes back to where it began, or no visit leads on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.segments import equal_runs
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import between_on_arc, path_lengths

#: What counts as the same place, in camera heights and heading, [rad], and the shortest lap, in camera
#: heights: those of revisits (:mod:`datagen.slam.loops`).
_NEAR_HEIGHTS, _NEAR_RAD, _SHORTEST_HEIGHTS = 1.5, 0.4, 20.0
#: Frames that another visit must go on for. Chosen: more than a few, so that a lap has few seams.
_LEAST_FRAMES = 3
#: Path over which a lap goes over from one visit to another, in camera heights. Chosen: visits lie up to a
#: camera height apart, and a sharper bend than the car can drive would be none.
_SEAM_HEIGHTS = 6.0
#: Frames at which a road is tried to begin, evenly over the drive, beside the first ones of all parts: these
#: may lie off the road.
_STARTS = 12
#: Step, in camera heights, above which poses are put between. Chosen: the spacing of the path is below.
_LONG_STEP_HEIGHTS = 0.5


def stitched_road(
    poses: Float[np.ndarray, "n 3"], part: Int[np.ndarray, "n"], camera_height_cm: float
) -> tuple[Float[np.ndarray, "k 3"], bool]:
    """Put one lap, or an open road, together from visits in different parts of a drive.

    Args:
        poses: Rear-axle poses after closing loops, frame map.
        part: Part of the drive that each frame belongs to.
        camera_height_cm: Sets the scale.

    Returns:
        Poses along the road, and whether it is closed: then the last one lies beside the first. Of the laps
        that were tried the one with the fewest seams; where none closes, the longest open road.
    """
    ends = np.empty(len(poses), np.int64)
    for run in equal_runs(part):
        ends[run] = run[-1]
    tried = np.concatenate(
        [np.linspace(0, len(poses) - 1, _STARTS).astype(int), np.flatnonzero(np.diff(part, prepend=-1))]
    )
    roads = [_walk(poses, ends, start, camera_height_cm) for start in np.unique(tried).tolist()]
    laps = [road for road in roads if road.closed]
    if laps:
        return min(laps, key=lambda road: road.seams).poses, True
    return max(roads, key=lambda road: float(path_lengths(road.poses)[-1])).poses, False


def with_long_steps_filled(
    poses: Float[np.ndarray, "n 3"], camera_height_cm: float
) -> Float[np.ndarray, "k 3"]:
    """Put poses on the arcs of steps over gaps, so that a path bends there as the car did."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    pieces = np.maximum(np.ceil(steps / (_LONG_STEP_HEIGHTS * camera_height_cm)), 1.0).astype(int)
    row = np.repeat(np.arange(len(steps)), pieces)
    share = (np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[row]
    end = poses[row + 1].copy()
    end[:, 2] = poses[row, 2] + wrap_angle(poses[row + 1, 2] - poses[row, 2])
    return np.concatenate([between_on_arc(poses[row], end, share), poses[-1:]])


class _Road(NamedTuple):
    """What was walked: poses, how often it went over to another visit, and whether it came back."""

    poses: Float[np.ndarray, "k 3"]
    seams: int
    closed: bool


def _walk(poses: Float[np.ndarray, "n 3"], ends: Int[np.ndarray, "n"], start: int, height_cm: float) -> _Road:
    """Follow the drive from a frame until it is passed again, or no visit leads on."""
    k, seams, gone, since = start, 0, 0.0, np.inf
    offset, beside = np.zeros(3), np.zeros(3)
    lap = [poses[start]]
    for _ in range(2 * len(poses)):
        if gone > _SHORTEST_HEIGHTS * height_cm and _passed(poses[k], poses[start], height_cm):
            return _Road(np.array(lap), seams, True)
        if k == ends[k]:
            ahead = _other_visit(poses, ends, k, height_cm)
            if ahead is None:
                break
            offset = poses[k] + beside - poses[ahead]
            offset[2] = wrap_angle(offset[2:])[0]
            k, seams, since = ahead, seams + 1, 0.0
        else:
            step = float(np.hypot(*(poses[k + 1] - poses[k])[:2]))
            k, gone, since = k + 1, gone + step, since + step
        beside = offset * max(0.0, 1.0 - since / (_SEAM_HEIGHTS * height_cm))
        lap.append(poses[k] + beside)
    return _Road(np.array(lap), seams, False)


def _passed(pose: Float[np.ndarray, "3"], place: Float[np.ndarray, "3"], height_cm: float) -> bool:
    """Whether a pose is beside a place, or has just passed it."""
    dx, dy = place[:2] - pose[:2]
    if np.hypot(dx, dy) > _NEAR_HEIGHTS * height_cm:
        return False
    ahead = dx * np.cos(pose[2]) + dy * np.sin(pose[2])
    return bool(ahead <= 0.0 and abs(wrap_angle(np.array([place[2] - pose[2]]))[0]) < _NEAR_RAD)


def _other_visit(
    poses: Float[np.ndarray, "n 3"], ends: Int[np.ndarray, "n"], k: int, height_cm: float
) -> int | None:
    """Find the frame just ahead of a part's last one from which another visit goes on for longest."""
    dx, dy = (poses[:, :2] - poses[k, :2]).T
    ahead = dx * np.cos(poses[k, 2]) + dy * np.sin(poses[k, 2])
    near = (np.hypot(dx, dy) < _NEAR_HEIGHTS * height_cm) & (ahead >= 0.0)
    near &= np.abs(wrap_angle(poses[:, 2] - poses[k, 2])) < _NEAR_RAD
    left = np.where(near, ends - np.arange(len(poses)), -1)
    best = int(left.argmax())
    return best if left[best] >= _LEAST_FRAMES else None
