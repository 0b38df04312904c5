"""Revisits that bear each other out: what a common drift does not explain may still be true.

Where a car slides, or its pictures are blurred, the open loop loses heading at once, and every later revisit
misses more than any steady drift would. Such revisits still agree with those beside them: between the earlier
visits of two of them it is the same way as between the later ones. Several places in a row do not agree by
chance, while a single place that looks like another one has no witness.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datagen.slam.places import Revisit, RevisitSettings, path_lengths, relative_pose

#: What two revisits may miss of each other: in camera heights, as a share of the way between them, which the
#: open loop drifts over, and in heading.
AGREE_HEIGHTS, AGREE_WAY, AGREE_RAD = 0.6, 0.06, 0.2
#: Way over which revisits are compared, camera heights: further on, the open loop has drifted too much.
_NEAR_HEIGHTS = 20.0
#: Way between two places that count as two, camera heights: on a road that repeats itself, neighbouring
#: frames all show the same wrong place, and agree on it.
_PLACE_HEIGHTS = 3.0
#: Heading by which a revisit may miss the common drift, so that its whole turns are still known.
_MOST_MISSED_RAD = 2.0


def with_supported(
    poses: Float[np.ndarray, "n 3"],
    explained: list[Revisit],
    matched: list[Revisit],
    camera_height_cm: float,
    settings: RevisitSettings,
) -> list[Revisit]:
    """Add the revisits that a common drift does not explain, but other revisits beside them do.

    Args:
        poses: Open-loop trajectory, heading unwrapped.
        explained: Revisits that a common drift explains, with their whole turns.
        matched: All candidates.
        camera_height_cm: Sets the scale.
        settings: Bounds.

    Returns:
        The revisits in the order of the candidates.
    """
    path = path_lengths(poses)
    known = {(r.earlier, r.later): r for r in explained}
    rate = np.median([_missed_rad(poses, r) / (path[r.later] - path[r.earlier]) for r in explained])
    nodes: list[Revisit] = []
    for r in matched:
        one = known.get((r.earlier, r.later))
        if one is None:
            off = _missed_rad(poses, replace(r, turns=0)) - rate * (path[r.later] - path[r.earlier])
            one = replace(r, turns=round(off / (2.0 * np.pi)))
            if abs(off - 2.0 * np.pi * one.turns) > _MOST_MISSED_RAD:
                continue
        nodes.append(one)
    group = list(range(len(nodes)))
    for i, a in enumerate(nodes):
        for j in range(i):
            if group[i] != group[j] and _agree(poses, path, a, nodes[j], camera_height_cm):
                group = [group[j] if g == group[i] else g for g in group]
    kept = []
    for one, mine in zip(nodes, group, strict=True):
        ways = path[[r.later for r, g in zip(nodes, group, strict=True) if g == mine]]
        if (one.earlier, one.later) in known or separate_places(
            ways, camera_height_cm
        ) >= settings.min_revisits:
            kept.append(one)
    return kept


def separate_places(ways_cm: Float[np.ndarray, "r"], camera_height_cm: float) -> int:
    """Number of separate places among some that lie so far along a drive."""
    count, last = 0, -np.inf
    for way in np.sort(ways_cm):
        if way - last >= _PLACE_HEIGHTS * camera_height_cm:
            count, last = count + 1, way
    return count


def _missed_rad(poses: Float[np.ndarray, "n 3"], r: Revisit) -> float:
    """Heading that the open loop misses between the visits."""
    return float(poses[r.later, 2] - poses[r.earlier, 2] - r.relative[2] - 2.0 * np.pi * r.turns)


def _agree(
    poses: Float[np.ndarray, "n 3"], path: Float[np.ndarray, "n"], a: Revisit, b: Revisit, height_cm: float
) -> bool:
    """Whether it is the same way between the earlier visits of two revisits as between the later ones."""
    between = max(abs(path[b.earlier] - path[a.earlier]), abs(path[b.later] - path[a.later]))
    if between > _NEAR_HEIGHTS * height_cm:
        return False
    if abs(_missed_rad(poses, a) - _missed_rad(poses, b)) > AGREE_RAD:
        return False
    first = compose(relative_pose(poses[a.earlier], poses[b.earlier]), b.relative)
    second = compose(a.relative, relative_pose(poses[a.later], poses[b.later]))
    off_cm = float(np.hypot(*(first - second)[:2]))
    return bool(off_cm < AGREE_HEIGHTS * height_cm + AGREE_WAY * between)


def compose(pose: Float[np.ndarray, "3"], relative: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Pose that is seen at ``relative`` from ``pose``."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y, turn = relative
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, pose[2] + turn])
