"""Stretches of one drive that show the same places become one map.

A break in the recording (frames deleted, the car lifted and put back) leaves stretches that know nothing of
each other. Where one shows places of another, pictures that look alike are aligned as revisits are. Each
alignment says how the one map lies on the other; those that agree carry the stretch over, and loop closure
and the adjustment of all frames together do the rest, with nothing assumed about the motion across the break.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleEstimate, Observations, adjust
from datagen.slam.camera.coarse import mapping_range
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.keyframes import key_pairs
from datagen.slam.loops.consistency import AGREE_HEIGHTS, AGREE_RAD, AGREE_SHARE, count_places
from datagen.slam.loops.pose_graph import close_loops, inlier_revisits, loop_pairs, neighbouring_laps
from datagen.slam.loops.revisits import Revisit, diagonal_mean, match_places, similarities, thumbnails
from datagen.slam.odometry.scans import Scans, scans_of
from datagen.slam.seen import road_edges
from datagen.slam.segment import MAX_MISFIT, MAX_MISSED, SolvedSegment
from datagen.slam.track import commands_of
from lanenet.data.drives import Drive
from lanenet.data.segments import equal_runs
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import compose, moved_rigidly, path_lengths, relative_pose

#: Frames beside a break whose surroundings belong to both stretches.
_EDGE = 21


@dataclass(frozen=True)
class Stretch:
    """A stretch of a drive, or several that have become one.

    Attributes:
        rows: Its frames, as positions in the drive.
        solved: Poses and scans.
    """

    rows: Int[np.ndarray, "n"]
    solved: SolvedSegment


def join_stretches(
    stretches: list[Stretch], drive: Drive, settings: MapSettings, rng: np.random.Generator, notes: list[str]
) -> list[Stretch]:
    """Carry stretches over onto the longest one whose loops are closed, where they show the same places.

    Args:
        stretches: Stretches of the drive, all with the same camera.
        drive: The drive.
        settings: Settings of all stages.
        rng: Source of randomness.
        notes: Gets what was joined.

    Returns:
        The stretches that are left, in the order of their first frames.
    """
    closed = [stretch for stretch in stretches if stretch.solved.revisits]
    if not closed or len(stretches) < 2:
        return stretches
    base = max(closed, key=lambda stretch: len(stretch.rows))
    apart = []
    for other in sorted((x for x in stretches if x is not base), key=lambda x: -len(x.rows)):
        joined = _join(base, other, drive, settings, rng, notes)
        if joined is None:
            apart.append(other)
        else:
            base = joined
    return sorted([base, *apart], key=lambda stretch: int(stretch.rows[0]))


def frames_text(drive: Drive, rows: Int[np.ndarray, "n"]) -> str:
    """Name rows of a drive by the frame numbers of their first and last ones, run by run."""
    runs = [rows[run] for run in equal_runs(rows - np.arange(len(rows)))]
    return "frames " + ", ".join(f"{drive.frames[run[0]]}-{drive.frames[run[-1]]}" for run in runs)


def _join(
    base: Stretch,
    other: Stretch,
    drive: Drive,
    settings: MapSettings,
    rng: np.random.Generator,
    notes: list[str],
) -> Stretch | None:
    """Carry a stretch over, and note it; None where it shows no place of the base, or does not fit."""
    camera, s = base.solved.camera, settings.revisits
    height, first = camera.mounting.height_cm, len(base.rows)
    drives = [drive.subset(stretch.rows) for stretch in (base, other)]
    breaks = np.concatenate([base.solved.breaks_or_none(), other.solved.breaks_or_none()])
    breaks[first] = True
    apart = np.concatenate([base.solved.poses, other.solved.poses])
    scans = _together(base.solved.scans, other.solved.scans)
    pictures = thumbnails(drives[0]), thumbnails(drives[1])
    found = []
    for pair in _shared_places(*pictures, s.min_similarity, s.max_pairs):
        match = match_places(scans, apart, pair, height, camera.wheelbase_cm, s, rng)
        if match is not None:
            found.append(match)
    cross, moved = _agreeing(apart, first, found, height)
    ways = path_lengths(apart[first:])[[r.later - first for r in cross]]
    if count_places(ways, height) < s.min_revisits:
        return None
    # Of both maps what they know of themselves already, beside what they share.
    later = [replace(r, earlier=r.earlier + first, later=r.later + first) for r in other.solved.revisits]
    revisits = [*base.solved.revisits, *later, *cross]
    laid = np.concatenate([base.solved.poses, moved])
    poses, missed = close_loops(laid, revisits, height, breaks)
    along, across = np.median(np.abs(missed[-len(cross) :, :2]), axis=0) / height
    if along > MAX_MISSED[0] or across > MAX_MISSED[1]:
        return None
    limits = mapping_range(height, settings.perception.range)
    roads = [
        road_edges(part, camera, limits, settings, stretch.solved.keys)
        for part, stretch in zip(drives, (base, other), strict=True)
    ]
    edges = [pixels for road in roads for pixels in road.edges]
    commands = [commands_of(part, camera.wheelbase_cm) for part in drives]
    # In one unit: the usual way of one stretch need not be that of the other one.
    ways_cm = np.concatenate([part.distance_cm for part in commands])
    expected = replace(commands[0], distance_cm=ways_cm, turn=None).relative_ways
    observed = Observations(edges, roads[0].keep, expected, commands[0].speed_known, breaks)
    tilt = np.concatenate([base.solved.bundle.tilt, other.solved.bundle.tilt])
    keys = _keys_of_both(base.solved, other.solved)
    held = [] if keys is None else key_pairs(keys, settings.bundle.lags, breaks)
    loops = loop_pairs(revisits, len(poses), breaks)
    for _ in range(2):
        start = BundleEstimate(poses, tilt, camera)
        bundle = adjust(observed, start, settings.bundle, rng, (), held + loops)
        poses, tilt = bundle.poses, bundle.tilt
        true = inlier_revisits(poses, revisits, height)
        loops = loop_pairs(true, len(poses), breaks) + neighbouring_laps(poses, height, s)
    alone = base.solved.bundle, other.solved.bundle
    before = np.average([b.misfit for b in alone], weights=[b.pairs for b in alone])
    if bundle.misfit > MAX_MISFIT * before:
        return None
    opened = moved_rigidly(other.solved.open_poses, other.solved.poses[0], bundle.poses[first])
    # From here on in the order of the drive: the base may be the later one, or lie on both sides.
    rows = np.concatenate([base.rows, other.rows])
    order = np.argsort(rows)
    place = np.argsort(order)
    breaks[0] = True
    breaks = breaks[order] & (np.arange(len(rows)) > 0)
    bundle = replace(bundle, poses=bundle.poses[order], tilt=bundle.tilt[order])
    solved = replace(
        base.solved,
        scans=scans_of([edges[i] for i in order], camera, limits, bundle.tilt),
        trajectory=_one_of_both(base.solved.trajectory, other.solved.trajectory, order),
        open_poses=np.concatenate([base.solved.open_poses, opened])[order],
        poses=bundle.poses,
        revisits=[replace(r, earlier=int(place[r.earlier]), later=int(place[r.later])) for r in revisits],
        bundle=bundle,
        breaks=breaks,
        keys=None if keys is None else np.sort(place[keys]),
    )
    notes.append(
        f"{frames_text(drive, other.rows)} lie on the same map as {frames_text(drive, base.rows)}: "
        f"{len(cross)} places seen in both"
    )
    return Stretch(rows[order], solved)


def _shared_places(
    base: Float[np.ndarray, "n d"], other: Float[np.ndarray, "m d"], min_similarity: float, max_pairs: int
) -> list[tuple[int, int]]:
    """Pairs of frames, one of either stretch, that look alike, each the other's most similar one.

    Args:
        base: A picture per frame of the first stretch, see :func:`datagen.slam.loops.revisits.thumbnails`.
        other: Likewise of the second, whose frames count on from those of the first.
        min_similarity: Correlation of the thumbnails, averaged over a few frames.
        max_pairs: Pairs at most, spread over the second stretch.
    """
    first = len(base)
    similarity = diagonal_mean(similarities(base, other))
    # What surrounds the last frames of one stretch must not be taken from the other one.
    inner = similarity[: max(first - _EDGE, 0)]
    if not inner.size:
        return []
    best: dict[int, tuple[float, int, int]] = {}
    every = max(1.0, len(other) / max_pairs)
    for k in range(_EDGE // 4, len(other)):
        earlier = int(inner[:, k].argmax())
        score = float(inner[earlier, k])
        # The neighbours of the most similar frame are nearly as similar: mutual within a few frames.
        if score < min_similarity or abs(int(similarity[earlier].argmax()) - k) > 3:
            continue
        pair = (score, earlier, first + k)
        key = int(k / every)
        best[key] = max(best.get(key, pair), pair)
    return [(earlier, later) for _, earlier, later in sorted(best.values(), key=lambda pair: pair[2])]


def _agreeing(
    poses: Float[np.ndarray, "n 3"], first: int, found: list[Revisit], height_cm: float
) -> tuple[list[Revisit], Float[np.ndarray, "m 3"]]:
    """The alignments with which most others agree, and the second stretch's poses as they place it.

    Args:
        poses: Poses of both stretches, each in its own map.
        first: First frame of the second stretch.
        found: Alignments.
        height_cm: Height of the camera, which sets the scale.
    """
    other = poses[first:]
    way = path_lengths(other)
    best: list[Revisit] = []
    moved = other
    for one in found:
        # Where the frame would be in the base's map.
        carried = moved_rigidly(other, other[one.later - first], compose(poses[one.earlier], one.relative))
        kept = []
        for r in found:
            seen = relative_pose(poses[r.earlier], carried[r.later - first]) - r.relative
            between = abs(way[r.later - first] - way[one.later - first])
            near = float(np.hypot(seen[0], seen[1])) < AGREE_HEIGHTS * height_cm + AGREE_SHARE * between
            if near and abs(float(wrap_angle(seen[2:])[0])) < AGREE_RAD:
                turns = carried[r.later - first, 2] - poses[r.earlier, 2] - r.relative[2]
                kept.append(replace(r, turns=round(turns / (2.0 * np.pi))))
        if len(kept) > len(best):
            best, moved = kept, carried
    return best, moved


def _together(a: Scans, b: Scans) -> Scans:
    starts = np.concatenate([a.starts, b.starts[1:] + a.starts[-1]])
    points, normals, weights = (
        np.concatenate([getattr(a, name), getattr(b, name)]) for name in ("points_cm", "normals", "weights")
    )
    return Scans(points, normals, weights, starts)


def _keys_of_both(a: SolvedSegment, b: SolvedSegment) -> Int[np.ndarray, "k"] | None:
    """Key frames of two segments, those of the second counted on; None where every frame is one."""
    if a.keys is None and b.keys is None:
        return None
    first, second = (np.arange(len(x.poses)) if x.keys is None else x.keys for x in (a, b))
    return np.concatenate([first, len(a.poses) + second])


def _one_of_both(a: Trajectory, b: Trajectory, order: Int[np.ndarray, "n"]) -> Trajectory:
    columns = {x.name: np.concatenate([getattr(a, x.name), getattr(b, x.name)]) for x in fields(a)}
    return Trajectory(**{name: column[order] for name, column in columns.items()})
