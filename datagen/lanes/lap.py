"""One lap as a closed path, on which the frames of all laps and of both directions have their place."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.path import Path, left_of
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import path_lengths

#: Frames whose heading is further than this from the road's, either way round, have no place on it: cosine.
_ALONG = 0.5
#: A frame further than this from the lap is on another road, in camera heights, and so is a drive of which
#: more than this share is.
_OFF_HEIGHTS, _MAX_OFF = 6.0, 0.15
#: Smoothing of the lap: enough that the offset of a line is a smooth function of the place.
_SMOOTH_CM = 6.0


def lap_path(
    poses: Float[np.ndarray, "n 3"],
    revisits: list[tuple[int, int]],
    step_cm: float,
    camera_height_cm: float,
) -> Path | None:
    """Close one lap of a drive and find the place of every frame on it.

    The lap is the stretch between the two visits of one place that miss each other least; what they miss is
    spread over it.

    Args:
        poses: Rear-axle poses after closing loops, frame map.
        revisits: Pairs of frames, earlier and later, that show the same place in the same direction.
        step_cm: Distance between samples, about.
        camera_height_cm: Sets the scale of bounds.

    Returns:
        The closed path; None where the drive does not repeat one lap: no revisit, or a tenth of the frames
        and more lie elsewhere.
    """
    base = _base_lap(poses, revisits)
    if base is None:
        return None
    first, last = base
    xy = poses[first : last + 1, :2]
    along = path_lengths(xy)
    xy = xy - (along / along[-1])[:, None] * (xy[-1] - xy[0])
    xy = _even(xy, step_cm)
    for _ in range(2):
        # Smoothing shortens bends, hence even spacing once more.
        spacing = float(np.linalg.norm(np.diff(xy, axis=0, append=xy[:1]), axis=1).mean())
        xy = gaussian_filter1d(xy, _SMOOTH_CM / spacing, axis=0, mode="wrap")
        xy = _even(np.concatenate([xy, xy[:1]]), step_cm)
    step = float(np.linalg.norm(np.diff(xy, axis=0, append=xy[:1]), axis=1).mean())
    path = Path(step, xy, left_of(np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)), np.empty(0), closed=True)
    s, d, forward = places_on_lap(path, poses)
    if np.mean(np.abs(d) > _OFF_HEIGHTS * camera_height_cm) > _MAX_OFF:
        return None
    return Path(step, path.xy_cm, path.left, s, d, forward, closed=True)


def places_on_lap(
    path: Path, poses: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Find each pose's position along a closed path, its offset to the left, and whether it drives along it.

    Where roads lie side by side or cross, heading and the place of the frame before tell them apart.
    """
    n, m = len(poses), len(path.xy_cm)
    period = m * path.step_cm
    s_all = path.s_cm
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
            # No more than the width of a road: a wrong place is left again.
            cost = cost + np.minimum(0.5 * miss, 30.0)
        cost = cost + np.where(np.abs(cosine) < _ALONG, 1e6, 0.0)
        i = int(np.argmin(cost))
        along = float(apart[i] @ [path.left[i, 1], -path.left[i, 0]])
        s[k] = np.mod(s_all[i] + np.clip(along, -path.step_cm, path.step_cm), period)
        d[k] = float(apart[i] @ path.left[i])
        forward[k] = bool(cosine[i] > 0.0)
        if k + 1 < n:
            expected = s[k] + (moved[k + 1] if forward[k] else -moved[k + 1])
    return s, d, forward


def _base_lap(poses: Float[np.ndarray, "n 3"], revisits: list[tuple[int, int]]) -> tuple[int, int] | None:
    """Pair of frames one lap apart that lie closest together."""
    if not revisits:
        return None
    path = path_lengths(poses)
    pairs = np.array(revisits)
    gaps = path[pairs[:, 1]] - path[pairs[:, 0]]
    # Later visits may skip laps: the shortest gaps are those of one lap.
    pairs = pairs[gaps < 1.4 * np.percentile(gaps, 10)]
    step = poses[pairs[:, 1]] - poses[pairs[:, 0]]
    turn = np.abs(wrap_angle(step[:, 2]))
    apart = np.linalg.norm(step[:, :2], axis=1) * (1.0 + turn)
    first, last = (int(k) for k in pairs[int(np.argmin(np.where(turn < np.pi / 3.0, apart, np.inf)))])
    # The two frames need not be at exactly one place along the road: take the frame nearest to the first.
    near = np.arange(max(first + 2, last - 20), min(len(poses), last + 21))
    ahead = np.stack([np.cos(poses[first, 2]), np.sin(poses[first, 2])])
    last = int(near[int(np.argmin(np.abs((poses[near, :2] - poses[first, :2]) @ ahead)))])
    closed = path[last] - path[first]
    missed = float(np.linalg.norm(poses[last, :2] - poses[first, :2]))
    return None if missed > 0.1 * closed else (first, last)


def _even(xy: Float[np.ndarray, "m 2"], step_cm: float) -> Float[np.ndarray, "k 2"]:
    """Sample a closed polygon, whose last point is its first, evenly."""
    along = path_lengths(xy) + 1e-6 * np.arange(len(xy))
    samples = np.linspace(0.0, along[-1], max(8, round(along[-1] / step_cm)) + 1)[:-1]
    return np.stack([np.interp(samples, along, xy[:, i]) for i in range(2)], axis=1)
