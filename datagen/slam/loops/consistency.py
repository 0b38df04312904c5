"""Which revisits to believe: those that one drift explains, and those that agree with each other.

The open loop misses heading in proportion to its length, nearly: most of it comes from a camera that looks a
little to the side, or a speed that is a little off. A common drift therefore explains the true revisits.

Where a car slides, or its images are blurred, the open loop loses heading at once, and every later revisit
misses more than a steady drift would. Such revisits still agree pairwise: the motion between the earlier
visits of two of them is the motion between the later ones. Several places in a row do not agree by chance,
while a single place that looks like another one has nothing to agree with.

By the same measure, with tighter bounds, a revisit contradicts those beside it where it takes one dash of a
line for the next. A common drift does not notice a dash, and the map would be bent to make them meet.

Source:
    Pairwise consistency as in Mangelson et al. 2018, "Pairwise consistent measurement set maximization for
    robust multi-robot map merging" (ICRA); here by connected groups and by votes instead of the largest
    clique.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from datagen.slam.loops.revisits import Revisit, RevisitSettings
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import compose, path_lengths, relative_pose

#: Heading per lap, [rad], up to which the drift of an open loop is small. With yaw and lever arm of the
#: camera fitted, ``garage_tape`` drifted by 0.14 and ``usi_mat`` by 0.65.
_SMALL_DRIFT_RAD = 0.6
#: Gaps between two visits up to so many times the shortest tenth of them are those of one lap. Chosen: below
#: two, with room for places at the ends of the tenth.
_ONE_LAP = 1.4
#: Logarithm by which paths that count as equally long may differ. Chosen: half a corner of a ring of eight.
_SAME_LENGTH = 0.07
#: What two revisits may miss of each other: in camera heights, as a share of the path between them, over
#: which the open loop drifts, and in heading, [rad]. Chosen: less than a lane, and than the drift of a bad
#: open loop.
AGREE_HEIGHTS, AGREE_SHARE, AGREE_RAD = 0.6, 0.06, 0.2
#: The same for a contradiction; in heading, also per camera height of path. Tighter: over a path that two
#: laps share the open loop misses about the same twice. A dash with its gap is about a camera height or more.
_SAME_HEIGHTS, _SAME_SHARE, _SAME_RAD, _SAME_RAD_PER_HEIGHT = 0.25, 0.02, 0.05, 0.002
#: Path over which revisits are compared, camera heights: further on, the open loop has drifted too much.
_NEAR_HEIGHTS = 20.0
#: Path between two places that count as two, camera heights: on a road that repeats itself, neighbouring
#: frames all show the same wrong place, and agree on it.
_PLACE_HEIGHTS = 3.0
#: Heading by which a revisit may miss the common drift, [rad], so that its whole turns are still known: well
#: below pi.
_MOST_MISSED_RAD = 2.0


def consistent_revisits(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], settings: RevisitSettings
) -> list[tuple[list[Revisit], float]]:
    """Group the revisits by the drift of the heading that explains them, and count their whole turns.

    The drift is known up to whole turns per lap: a lap that turns once, and one that does not turn at all or
    turns the other way, explain the same revisits with drifts that are a turn apart. The map decides which
    one is true.

    Args:
        poses: Open-loop trajectory, heading unwrapped.
        revisits: Candidates.
        settings: Bounds.

    Returns:
        The revisits with their turns, and the drift, [rad/cm], once for each count of turns per lap.
    """
    if len(revisits) < settings.min_revisits:
        return []
    path = path_lengths(poses)
    earlier, later = (np.array([getattr(r, name) for r in revisits]) for name in ("earlier", "later"))
    between = path[later] - path[earlier]
    missed = poses[later, 2] - poses[earlier, 2] - np.array([r.relative[2] for r in revisits])
    lap = float(np.median(between[of_one_lap(between)]))
    limit = settings.max_drift_rad / lap
    # Changes of the drift add up over the laps.
    tolerance = settings.drift_tolerance_rad * np.sqrt(np.maximum(between / lap, 1.0))
    count = int(10.0 * limit * between.max() / settings.drift_tolerance_rad)
    rates = np.linspace(-limit, limit, 2 * count + 1)
    rest = wrap_angle(missed - rates[:, None] * between)
    explained = np.sum(np.exp(-0.5 * (rest / (0.5 * tolerance)) ** 2), axis=1)
    # Places that look alike may agree on a large drift by chance: a small one is tried in any case.
    small = np.where(np.abs(rates) * lap <= _SMALL_DRIFT_RAD, explained, -1.0)
    laps = np.maximum(np.rint(between / lap), 1.0).astype(int)
    found: list[tuple[list[Revisit], float]] = []
    for best in dict.fromkeys((int(np.argmax(explained)), int(np.argmax(small)))):
        expected, rest_of = rates[best] * between, rest[best]
        for _ in range(2):
            # The drift may grow or shrink along the path.
            good = np.abs(rest_of) <= tolerance
            if good.sum() < settings.min_revisits:
                break
            terms = np.stack([between, path[later] ** 2 - path[earlier] ** 2], axis=1)
            scale = np.abs(terms).max(axis=0)
            fitted = np.linalg.lstsq(terms[good] / scale, (expected + rest_of)[good], rcond=None)[0]
            expected = terms / scale @ fitted
            rest_of = wrap_angle(missed - expected)
        turns = np.rint((missed - expected) / (2.0 * np.pi)).astype(int)
        good = np.abs(rest_of) <= tolerance
        for more in (0, -1, 1):
            rate = float(np.median(expected / between)) - 2.0 * np.pi * more / lap
            whole = turns + more * laps
            kept = [replace(r, turns=int(t)) for r, t, ok in zip(revisits, whole, good, strict=True) if ok]
            known = [[(r.earlier, r.later, r.turns) for r in group] for group, _ in found]
            new = [(r.earlier, r.later, r.turns) for r in kept] not in known
            if abs(rate) <= limit and len(kept) >= settings.min_revisits and new:
                found.append((kept, rate))
    return found


def with_supported(
    poses: Float[np.ndarray, "n 3"],
    explained: list[Revisit],
    matched: list[Revisit],
    camera_height_cm: float,
    settings: RevisitSettings,
) -> list[Revisit]:
    """Add the revisits that no common drift explains, but that agree with enough others at separate places.

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
    group = np.arange(len(nodes))
    for i, a in enumerate(nodes):
        for j in range(i):
            if group[i] != group[j] and _agree(poses, path, a, nodes[j], camera_height_cm):
                group[group == group[i]] = group[j]
    later = np.array([r.later for r in nodes], dtype=np.intp)
    return [
        one
        for one, mine in zip(nodes, group, strict=True)
        if (one.earlier, one.later) in known
        or count_places(path[later[group == mine]], camera_height_cm) >= settings.min_revisits
    ]


def without_contradicted(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], camera_height_cm: float
) -> list[Revisit]:
    """Leave out the revisits that more of those beside them contradict than agree with, the worst first.

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
            near = off_cm < _SAME_HEIGHTS * camera_height_cm + _SAME_SHARE * between
            same = near and off_rad < _SAME_RAD + _SAME_RAD_PER_HEIGHT * between / camera_height_cm
            votes[i, j] = votes[j, i] = 1 if same else -1
    kept = list(range(count))
    while kept:
        sums = votes[np.ix_(kept, kept)].sum(axis=1)
        if sums.min() >= 0:
            break
        del kept[int(sums.argmin())]
    return [revisits[k] for k in kept]


def of_one_lap(between_cm: Float[np.ndarray, "r"]) -> Bool[np.ndarray, "r"]:
    """Which paths between two visits of a place are one lap long: later visits may skip laps."""
    return between_cm <= _ONE_LAP * np.percentile(between_cm, 10)


def of_one_length(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], settings: RevisitSettings
) -> list[list[Revisit]]:
    """Group the revisits between whose visits the path is about as long, the largest group first.

    On a ring whose corners all look alike, each corner is taken for each other: every group is right or wrong
    as a whole.

    Args:
        poses: Open-loop trajectory.
        revisits: Revisits; one that has too few of its length is in no group.
        settings: Bounds.
    """
    path = path_lengths(poses)
    left, groups = list(revisits), []
    while len(left) >= settings.min_revisits:
        length = np.log([path[r.later] - path[r.earlier] for r in left])
        near = np.abs(length - length[:, None]) < _SAME_LENGTH
        most = near[int(near.sum(axis=0).argmax())]
        if most.sum() < settings.min_revisits:
            break
        groups.append([r for r, one in zip(left, most, strict=True) if one])
        left = [r for r, one in zip(left, most, strict=True) if not one]
    return groups


def count_places(along_cm: Float[np.ndarray, "r"], camera_height_cm: float) -> int:
    """Count the separate places among positions along a path."""
    count, last = 0, -np.inf
    for position in np.sort(along_cm):
        if position - last >= _PLACE_HEIGHTS * camera_height_cm:
            count, last = count + 1, position
    return count


def _missed_rad(poses: Float[np.ndarray, "n 3"], r: Revisit) -> float:
    """Heading that the open loop misses between the visits."""
    return float(poses[r.later, 2] - poses[r.earlier, 2] - r.relative[2] - 2.0 * np.pi * r.turns)


def _between(path_cm: Float[np.ndarray, "n"], a: Revisit, b: Revisit) -> float:
    """The longer of the paths between the earlier and between the later visits of two revisits."""
    return float(max(abs(path_cm[b.earlier] - path_cm[a.earlier]), abs(path_cm[b.later] - path_cm[a.later])))


def _agree(
    poses: Float[np.ndarray, "n 3"], path: Float[np.ndarray, "n"], a: Revisit, b: Revisit, height_cm: float
) -> bool:
    """Whether the motion between the earlier visits of two revisits is that between the later ones."""
    between = _between(path, a, b)
    if between > _NEAR_HEIGHTS * height_cm:
        return False
    if abs(_missed_rad(poses, a) - _missed_rad(poses, b)) > AGREE_RAD:
        return False
    off_cm, _ = _off(poses, a, b)
    return bool(off_cm < AGREE_HEIGHTS * height_cm + AGREE_SHARE * between)


def _off(poses: Float[np.ndarray, "n 3"], a: Revisit, b: Revisit) -> tuple[float, float]:
    """By how much the motions between the visits of two revisits differ: distance, and angle."""
    first = compose(relative_pose(poses[a.earlier], poses[b.earlier]), b.relative)
    second = compose(a.relative, relative_pose(poses[a.later], poses[b.later]))
    x, y, turn = first - second
    return float(np.hypot(x, y)), abs(float(wrap_angle(np.array([turn]))[0]))
