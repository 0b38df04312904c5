"""Pairs of frames that show the same place, for the adjustment of all frames together."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from datagen.slam.places import Revisit, RevisitSettings, path_lengths
from lanenet.geometry.frames import wrap_angle

#: Where around a revisit more pairs of frames show the same place, in frames.
_BESIDE_REVISIT = range(-12, 13, 4)
#: Every so many frames one is compared with the nearest ones of so many earlier laps, if they are no further
#: away, in camera heights and in heading.
_BESIDE_EVERY, _BESIDE_LAPS, _BESIDE_HEIGHTS, _BESIDE_RAD = 3, 3, 1.5, 0.3
#: Way before the last frame of a lap that is near within which the nearest one of it lies, in camera heights.
_PASSING_HEIGHTS = 10.0


def loop_pairs(
    revisits: list[Revisit], count: int, breaks: Bool[np.ndarray, "n"] | None = None
) -> list[tuple[int, int]]:
    """Pairs of frames around each revisit that show the same place, not beyond a break of the drive.

    Args:
        revisits: The revisits.
        count: Number of frames.
        breaks: Frames that do not follow the one before them; None for one stretch.
    """
    stretch = np.zeros(count, np.int64) if breaks is None else np.cumsum(breaks)
    pairs = [(r, r.earlier + d, r.later + d) for r in revisits for d in _BESIDE_REVISIT]
    return [
        (a, b)
        for r, a, b in pairs
        if a >= 0 and b < count and stretch[a] == stretch[r.earlier] and stretch[b] == stretch[r.later]
    ]


def side_by_side(
    poses: Float[np.ndarray, "n 3"], camera_height_cm: float, settings: RevisitSettings
) -> list[tuple[int, int]]:
    """Pairs of frames of different laps that a closed map has at about the same place and heading.

    Revisits are too few to hold all of one lap on the others; between them every lap would have lines of its
    own. Laps that hang on one other lap each may still lie apart from the rest.

    Args:
        poses: Rear-axle poses after closing loops.
        camera_height_cm: Sets the scale.
        settings: What counts as another visit.
    """
    path = path_lengths(poses)
    pairs = []
    for later in range(0, len(poses), _BESIDE_EVERY):
        apart = np.hypot(*(poses[:later, :2] - poses[later, :2]).T)
        turned = np.abs(wrap_angle(poses[:later, 2] - poses[later, 2]))
        near = np.flatnonzero((turned < _BESIDE_RAD) & (apart < _BESIDE_HEIGHTS * camera_height_cm))
        visit = later
        for _ in range(_BESIDE_LAPS):
            near = near[path[near] <= path[visit] - settings.min_gap_heights * camera_height_cm]
            if not near.size:
                break
            passing = near[path[near] > path[near[-1]] - _PASSING_HEIGHTS * camera_height_cm]
            visit = int(passing[np.argmin(apart[passing])])
            pairs.append((visit, later))
    return pairs
