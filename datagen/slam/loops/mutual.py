"""Revisits that bear each other out: what a common drift does not explain may still be true.

Where a car slides, or its pictures are blurred, the open loop loses heading at once, and every later revisit
misses more than any steady drift would. Such revisits still agree with those beside them: between the earlier
visits of two of them it is the same way as between the later ones. Several places in a row do not agree by
chance, while a single place that looks like another one has no witness.

By the same measure, but a narrower one, a revisit stands against those beside it where it takes one dash of a
row for the next: the common drift does not mind a dash, and the map would be bent to make them meet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from datagen.slam.loops.places import Revisit, RevisitSettings
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import compose, path_lengths, relative_pose

#: What two revisits may miss of each other: in camera heights, as a share of the way between them, which the
#: open loop drifts over, and in heading.
AGREE_HEIGHTS, AGREE_WAY, AGREE_RAD = 0.6, 0.06, 0.2
#: The same for a revisit that is not to be contradicted; in heading, also for each camera height of way. Over
#: a way that two laps have in common the open loop misses about the same, so that little of its drift counts.
_SAME_HEIGHTS, _SAME_WAY, _SAME_RAD, _SAME_RAD_HEIGHT = 0.25, 0.02, 0.05, 0.002
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


def without_contradicted(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], camera_height_cm: float
) -> list[Revisit]:
    """Leave out the revisits that more of those beside them stand against than agree with, the worst first.

    Args:
        poses: Open-loop trajectory.
        revisits: Revisits.
        camera_height_cm: Sets the scale.

    Returns:
        Those that are left, in the same order.
    """
    path, count = path_lengths(poses), len(revisits)
    votes = np.zeros((count, count), np.int64)
    for i, a in enumerate(revisits):
        for j in range(i):
            between = _between(path, a, revisits[j])
            if between > _NEAR_HEIGHTS * camera_height_cm:
                continue
            off_cm, off_rad = _off(poses, a, revisits[j])
            near = off_cm < _SAME_HEIGHTS * camera_height_cm + _SAME_WAY * between
            same = near and off_rad < _SAME_RAD + _SAME_RAD_HEIGHT * between / camera_height_cm
            votes[i, j] = votes[j, i] = 1 if same else -1
    kept = list(range(count))
    while kept:
        sums = votes[np.ix_(kept, kept)].sum(axis=1)
        if sums.min() >= 0:
            break
        del kept[int(sums.argmin())]
    return [revisits[k] for k in kept]


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


def _between(path_cm: Float[np.ndarray, "n"], a: Revisit, b: Revisit) -> float:
    """Longer one of the ways between the earlier, and between the later visits of two revisits."""
    return float(max(abs(path_cm[b.earlier] - path_cm[a.earlier]), abs(path_cm[b.later] - path_cm[a.later])))


def _agree(
    poses: Float[np.ndarray, "n 3"], path: Float[np.ndarray, "n"], a: Revisit, b: Revisit, height_cm: float
) -> bool:
    """Whether it is the same way between the earlier visits of two revisits as between the later ones."""
    between = _between(path, a, b)
    if between > _NEAR_HEIGHTS * height_cm:
        return False
    if abs(_missed_rad(poses, a) - _missed_rad(poses, b)) > AGREE_RAD:
        return False
    off_cm, _ = _off(poses, a, b)
    return bool(off_cm < AGREE_HEIGHTS * height_cm + AGREE_WAY * between)


def _off(poses: Float[np.ndarray, "n 3"], a: Revisit, b: Revisit) -> tuple[float, float]:
    """What the ways between the visits of two revisits miss of each other: distance, and angle."""
    first = compose(relative_pose(poses[a.earlier], poses[b.earlier]), b.relative)
    second = compose(a.relative, relative_pose(poses[a.later], poses[b.later]))
    x, y, turn = first - second
    return float(np.hypot(x, y)), abs(float(wrap_angle(np.array([turn]))[0]))
