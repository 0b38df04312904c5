"""Parts of a drive between long gaps: which revisits place one on another, and which hang together.

A drive is recorded in parts: the driver paused, lifted the car and put it elsewhere, or let it roll so far
that no image bridges the gap. Nothing is known of the motion from one part to the next. Where one shows
places of another, each revisit between them places it there; those that agree carry it over. What hangs
together this way is one map; what does not has a map of its own.

A part of a few frames is no map: neither the images nor the motion model determine its poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.slam.loops.consistency import AGREE_HEIGHTS, AGREE_RAD, AGREE_SHARE, count_places
from datagen.slam.loops.revisits import Revisit
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import compose, moved_rigidly, path_lengths, relative_pose

#: Separate places at which revisits must agree to place one part on another. Chosen: one place may look like
#: another one by chance; that a second one at the right distance from it does, too, is rare.
_LEAST_PLACES = 2
#: Placements of one part on another that are compared. Chosen: those on both corridors of an office, each in
#: both directions.
_MOST_RIVALS = 4
#: Standard deviation of the way over which a car is carried, turned round or rolls at a break of the
#: recording, in camera heights, and likelihood of any other place beside the one where it was. Chosen: a
#: length of a car and a half; one break of a hundred, since recordings also stop while the car drives.
_CARRIED_HEIGHTS, _ELSEWHERE = 3.5, 0.01
#: Log likelihood at most of places that agree, over places that look alike as a whole, as those of parallel
#: corridors. Chosen: it outweighs one break over which the car went elsewhere, but not two.
JOINED = 6.0
#: Way beyond a revisit over which odometry holds poses, in camera heights. Chosen: less than half of that
#: over which revisits are looked for beside others, so that those of a lap hold all of it.
_HELD_HEIGHTS = 5.0
#: Frames of a part that show the road, without which its poses are not determined. Chosen: the motion model
#: holds only changes of speed and of turn, which takes three frames; speed and turn themselves are left to
#: the images, and a fourth frame checks them.
LEAST_TIED = 4


def placing_revisits(
    poses: Float[np.ndarray, "n 3"],
    part: Int[np.ndarray, "n"],
    revisits: Sequence[Revisit],
    camera_height_cm: float,
) -> list[Revisit]:
    """Choose the revisits that place parts on each other, as many as agree, and no part twice.

    Places that look alike place a part here or there, as on one of two parallel corridors. Most often a car
    goes on near where it was stopped, turned round or put down: rival sets of revisits are compared by their
    number, as far as it counts, less what :func:`carried` costs; one that costs more is not believed.

    Args:
        poses: Poses, each part in shape, in any place.
        part: Part of the drive that each frame belongs to.
        revisits: Candidates.
        camera_height_cm: Sets the scale.

    Returns:
        For parts that are joined a set of revisits that agree, with their whole turns; the likeliest sets
        first. Sets that would join parts twice are left out: other evidence decides on them.
    """
    between: dict[tuple[int, int], list[Revisit]] = {}
    for r in revisits:
        if part[r.earlier] != part[r.later]:
            pair = sorted((int(part[r.earlier]), int(part[r.later])))
            between.setdefault((pair[0], pair[1]), []).append(r)
    path, group, placed = path_lengths(poses), part.copy(), poses.copy()
    breaks = np.flatnonzero(np.diff(part))
    sets = []
    for (_, moved), found in between.items():
        for _ in range(_MOST_RIVALS):
            agreeing = _largest_agreeing(poses, part, moved, found, camera_height_cm)
            at = [r.later if part[r.later] == moved else r.earlier for r in agreeing]
            if count_places(path[at], camera_height_cm) < _LEAST_PLACES:
                break
            sets.append(agreeing)
            found = [r for r in found if all(r is not one for one in agreeing)]

    def joined(agreeing: list[Revisit]) -> tuple[tuple[float, int], Float[np.ndarray, "n 3"]]:
        """How likely a set is, with its size, and the poses with the group of the later visits moved."""
        r, trial = agreeing[0], placed.copy()
        a, b = group[r.earlier], group[r.later]
        mine = group == b
        trial[mine] = moved_rigidly(placed[mine], placed[r.later], compose(placed[r.earlier], r.relative))
        before, after = group[breaks], group[breaks + 1]
        joining = breaks[((before == a) & (after == b)) | ((before == b) & (after == a))]
        likelihood = min(len(agreeing), JOINED) - carried(trial, joining, camera_height_cm)
        return (likelihood, len(agreeing)), trial

    chosen: list[Revisit] = []
    while sets:
        likeliest = max(sets, key=lambda one: joined(one)[0])
        (likelihood, _), trial = joined(likeliest)
        if likelihood < 0.0:
            break
        placed, chosen = trial, chosen + likeliest
        group[group == group[likeliest[0].later]] = group[likeliest[0].earlier]
        sets = [one for one in sets if group[one[0].earlier] != group[one[0].later]]
    return [replace(r, turns=whole_turns(poses, r)) for r in chosen]


def joined_twice(
    poses: Float[np.ndarray, "n 3"],
    part: Int[np.ndarray, "n"],
    revisits: Sequence[Revisit],
    camera_height_cm: float,
) -> list[Revisit]:
    """Leave out revisits that alone, at a single place, join parts which nothing else joins.

    Args:
        poses: Poses, each part in shape, in any place.
        part: Part of the drive that each frame belongs to.
        revisits: Revisits.
        camera_height_cm: Sets the scale.
    """
    path, kept = path_lengths(poses), list(revisits)
    pairs = {(int(min(ends)), int(max(ends))) for ends in ((part[r.earlier], part[r.later]) for r in kept)}
    for a, b in sorted(pair for pair in pairs if pair[0] != pair[1]):
        these = [r for r in kept if {int(part[r.earlier]), int(part[r.later])} == {a, b}]
        at = [r.later if part[r.later] == b else r.earlier for r in these]
        if count_places(path[at], camera_height_cm) < _LEAST_PLACES:
            others = [r for r in kept if all(r is not one for one in these)]
            group = connected(part, others)
            if len(np.unique(group[(part == a) | (part == b)])) > 1:
                kept = others
    return kept


def hanging(
    poses: Float[np.ndarray, "n 3"],
    part: Int[np.ndarray, "n"],
    revisits: Sequence[Revisit],
    camera_height_cm: float,
) -> Bool[np.ndarray, "n"]:
    """Return which frames are held at one end alone: beyond the first or the last revisit of their part.

    Args:
        poses: Poses.
        part: Part of the drive that each frame belongs to.
        revisits: Revisits.
        camera_height_cm: Sets the scale.
    """
    path, loose = path_lengths(poses), np.ones(len(part), dtype=bool)
    held = np.array([end for r in revisits for end in (r.earlier, r.later)], dtype=np.int64)
    for number in np.unique(part[held]):
        rows, reach_cm = np.flatnonzero(part == number), _HELD_HEIGHTS * camera_height_cm
        ends_cm = path[held[part[held] == number]]
        beyond_cm = np.maximum(ends_cm.min() - path[rows], path[rows] - ends_cm.max())
        loose[rows] = beyond_cm > reach_cm
    return loose


def carried(poses: Float[np.ndarray, "n 3"], breaks: Int[np.ndarray, "b"], camera_height_cm: float) -> float:
    """Negative log likelihood of the ways from the last frame before a break to the first one behind it.

    Args:
        poses: Poses on one map.
        breaks: Last frames before breaks of the recording.
        camera_height_cm: Sets the scale.
    """
    way_cm = np.diff(poses[np.stack([breaks, breaks + 1]), :2], axis=0)[0]
    near = np.exp(-0.5 * np.sum((way_cm / (_CARRIED_HEIGHTS * camera_height_cm)) ** 2, axis=1))
    return -float(np.log((near + _ELSEWHERE) / (1.0 + _ELSEWHERE)).sum())


def whole_turns(poses: Float[np.ndarray, "n 3"], revisit: Revisit) -> int:
    """Count the whole turns to the left between the visits of a place, with unwrapped headings."""
    turned = poses[revisit.later, 2] - poses[revisit.earlier, 2] - revisit.relative[2]
    return round(float(turned) / (2.0 * np.pi))


def connected(part: Int[np.ndarray, "n"], revisits: Sequence[Revisit]) -> Int[np.ndarray, "n"]:
    """Number the groups of parts that revisits join, frame by frame, in the order of their first frames."""
    group = part.copy()
    for r in revisits:
        group[group == group[r.later]] = group[r.earlier]
    _, first, number = np.unique(group, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[number])


def tied_frames(
    part: Int[np.ndarray, "n"], keys: Int[np.ndarray, "k"], shows_road: Bool[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """Choose the parts whose poses are determined: all others would make the adjustment singular.

    No revisit makes up for it: a part is placed by places some camera heights apart, and one this short shows
    one place.

    Args:
        part: Part of the drive that each frame belongs to.
        keys: Keyframes by which the drive is tracked.
        shows_road: Frames that show edges of the road.

    Returns:
        All frames of these parts, in ascending order.
    """
    tying = np.bincount(part[keys], weights=shows_road[keys], minlength=int(part.max()) + 1)
    return np.flatnonzero(tying[part] >= LEAST_TIED)


def _largest_agreeing(
    poses: Float[np.ndarray, "n 3"],
    part: Int[np.ndarray, "n"],
    moved: int,
    revisits: list[Revisit],
    height_cm: float,
) -> list[Revisit]:
    """Find the largest set of revisits between two parts that agree with one of them, which comes first.

    Args:
        poses: Poses.
        part: Part of each frame.
        moved: The part that they move onto the other one.
        revisits: Revisits between the two.
        height_cm: Height of the camera, which sets the scale.
    """
    inside, target = [], []
    for r in revisits:
        later = part[r.later] == moved
        inside.append(r.later if later else r.earlier)
        back = relative_pose(r.relative, np.zeros(3))
        target.append(compose(poses[r.earlier], r.relative) if later else compose(poses[r.later], back))
    own, to = poses[inside], np.array(target)
    best = np.zeros(0, np.intp)
    for k, (one, place) in enumerate(zip(own, to, strict=True)):
        off = moved_rigidly(own, one, place) - to
        apart = np.hypot(*(own - one)[:, :2].T)
        near = np.hypot(off[:, 0], off[:, 1]) < AGREE_HEIGHTS * height_cm + AGREE_SHARE * apart
        agreeing = np.flatnonzero(near & (np.abs(wrap_angle(off[:, 2])) < AGREE_RAD))
        if len(agreeing) > len(best):
            best = np.concatenate([[k], agreeing[agreeing != k]])
    return [revisits[k] for k in best]
