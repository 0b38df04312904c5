"""Segments of one drive that show the same places become one map.

A break in the recording (frames deleted, the car lifted and put back) leaves segments whose maps know nothing
of each other. Where one shows places of another, images that look alike are aligned as revisits are. Each
alignment places one map on the other; those that agree carry the segment over. Loop closure and the
adjustment of all frames together follow, with nothing assumed about the motion across the break.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from datagen.slam.adjustment.adjust import BundleEstimate, BundleResult, adjust
from datagen.slam.commands import commands_of, joined_commands
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.keyframes import keyframe_pairs
from datagen.slam.loops.consistency import AGREE_HEIGHTS, AGREE_RAD, AGREE_SHARE, count_places
from datagen.slam.loops.pose_graph import close_loops, inlier_revisits, loop_pairs, neighbouring_laps
from datagen.slam.loops.revisits import (
    Revisit,
    best_of_each,
    diagonal_mean,
    match_places,
    similarities,
    thumbnails,
)
from datagen.slam.odometry.scans import Scans
from datagen.slam.segment import MAX_MISFIT, MAX_MISSED, SolvedSegment
from datagen.slam.settings import SlamSettings
from datagen.slam.view import RoadView, view_road
from lanenet.data.drives import Drive
from lanenet.data.segments import equal_runs
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import compose, moved_rigidly, path_lengths, relative_pose

#: Frames beside a break whose surroundings belong to both segments: as many as the small map of a place takes
#: to either side (:func:`match_places`), and the frame itself.
_EDGE = 21
#: Frames by which the most similar frame of the one segment may miss being the other's most similar one: its
#: neighbours are nearly as similar.
_MUTUAL = 3
#: Adjustments of a joined map: the second one leaves out the revisits that the first contradicts.
_ROUNDS = 2


@dataclass(frozen=True)
class JoinedSegments:
    """Segments that are left once those that show the same places were joined.

    Attributes:
        segments: In the order of their first frames.
        notes: What was joined, a sentence each.
    """

    segments: tuple[SolvedSegment, ...]
    notes: tuple[str, ...] = ()


def join_segments(
    segments: Sequence[SolvedSegment], drive: Drive, settings: SlamSettings, rng: np.random.Generator
) -> JoinedSegments:
    """Carry segments over onto the longest one with closed loops, where they show the same places.

    Args:
        segments: Segments of the drive, all with the same camera.
        drive: The drive.
        settings: Settings of all stages.
        rng: Source of randomness.
    """
    closed = [segment for segment in segments if segment.revisits]
    if not closed or len(segments) < 2:
        return JoinedSegments(tuple(segments))
    base = max(closed, key=lambda segment: len(segment.rows))
    apart, notes = [], []
    for other in sorted((x for x in segments if x is not base), key=lambda x: -len(x.rows)):
        pair = _Pair(base, other, drive, settings)
        places, moved = pair.shared_places(rng)
        joined = pair.join(places, moved, rng)
        if joined is None:
            apart.append(other)
            continue
        notes.append(
            f"{frames_text(drive, other.rows)} lie on the same map as {frames_text(drive, base.rows)}: "
            f"{len(places)} places seen in both"
        )
        base = joined
    left = sorted([base, *apart], key=lambda segment: int(segment.rows[0]))
    return JoinedSegments(tuple(left), tuple(notes))


def frames_text(drive: Drive, rows: Int[np.ndarray, "n"]) -> str:
    """Name rows of a drive by the frame numbers of their first and last ones, run by run."""
    runs = [rows[run] for run in equal_runs(rows - np.arange(len(rows)))]
    return "frames " + ", ".join(f"{drive.frames[run[0]]}-{drive.frames[run[-1]]}" for run in runs)


#: Places that both segments show, and the poses of the second one moved accordingly.
_Shared = tuple[list[Revisit], Float[np.ndarray, "m 3"]]


class _Pair:
    """Two segments as if they were one: the frames of the base, then those of the other."""

    def __init__(
        self, base: SolvedSegment, other: SolvedSegment, drive: Drive, settings: SlamSettings
    ) -> None:
        self.both, self.settings = (base, other), settings
        self.first = len(base.rows)
        self.drives = [drive.subset(segment.rows) for segment in self.both]
        self.camera = base.camera
        self.height = base.camera.mounting.height_cm
        self.breaks = np.concatenate([segment.break_flags for segment in self.both])
        self.breaks[self.first] = True

    def shared_places(self, rng: np.random.Generator) -> _Shared:
        """Align frames that look alike, and keep the alignments that agree."""
        s = self.settings.revisits
        apart = np.concatenate([segment.poses for segment in self.both])
        scans = _concatenated(*(segment.scans for segment in self.both))
        base, other = (thumbnails(drive) for drive in self.drives)
        found = []
        for pair in _alike_frames(base, other, s.min_similarity, s.max_pairs):
            match = match_places(scans, apart, pair, self.height, self.camera.wheelbase_cm, s, rng)
            if match is not None:
                found.append(match)
        return _agreeing(apart, self.first, found, self.height)

    def join(
        self, places: list[Revisit], moved: Float[np.ndarray, "m 3"], rng: np.random.Generator
    ) -> SolvedSegment | None:
        """Carry the other segment over; None where it shows too few places of the base, or does not fit."""
        base, other = self.both
        later = [r.later - self.first for r in places]
        path = path_lengths(other.poses)
        if count_places(path[later], self.height) < self.settings.revisits.min_revisits:
            return None
        # The loop closures of either map, beside what they share.
        own = [replace(r, earlier=r.earlier + self.first, later=r.later + self.first) for r in other.revisits]
        revisits = [*base.revisits, *own, *places]
        start = np.concatenate([base.poses, moved])
        poses, missed = close_loops(start, revisits, self.height, self.breaks)
        along, across = np.median(np.abs(missed[-len(places) :, :2]), axis=0) / self.height
        if along > MAX_MISSED[0] or across > MAX_MISSED[1]:
            return None
        roads = [
            view_road(drive, self.camera, self.settings, segment.keys)
            for drive, segment in zip(self.drives, self.both, strict=True)
        ]
        road = replace(roads[0], edges=[pixels for one in roads for pixels in one.edges])
        bundle = self.adjust(road, poses, revisits, rng)
        alone = [segment.bundle for segment in self.both]
        before = np.average([b.misfit for b in alone], weights=[b.pairs for b in alone])
        if bundle.misfit > MAX_MISFIT * before:
            return None
        return self.in_order_of_the_drive(road, bundle, revisits)

    @property
    def keys(self) -> Int[np.ndarray, "k"] | None:
        """Keyframes of both segments; None where every frame is one."""
        base, other = self.both
        if base.keys is None and other.keys is None:
            return None
        first, second = (np.arange(len(x.poses)) if x.keys is None else x.keys for x in self.both)
        return np.concatenate([first, self.first + second])

    def adjust(
        self,
        road: RoadView,
        poses: Float[np.ndarray, "n 3"],
        revisits: list[Revisit],
        rng: np.random.Generator,
    ) -> BundleResult:
        """Adjust the frames of both segments together."""
        # In centimetres: the typical step length of one segment need not be that of the other.
        commands = joined_commands([commands_of(drive, self.camera.wheelbase_cm) for drive in self.drives])
        settings, breaks = self.settings.bundle, self.breaks
        observed = road.observed(commands, breaks)
        tilt = np.concatenate([segment.bundle.tilt for segment in self.both])
        held = [] if self.keys is None else keyframe_pairs(self.keys, settings.lags, breaks)
        loops = loop_pairs(revisits, len(poses), breaks)
        for _ in range(_ROUNDS):
            start = BundleEstimate(poses, tilt, self.camera)
            bundle = adjust(observed, start, settings, rng, (), held + loops)
            poses, tilt = bundle.poses, bundle.tilt
            inliers = inlier_revisits(poses, revisits, self.height)
            loops = loop_pairs(inliers, len(poses), breaks)
            loops += neighbouring_laps(poses, self.height, self.settings.revisits)
        return bundle

    def in_order_of_the_drive(
        self, road: RoadView, bundle: BundleResult, revisits: list[Revisit]
    ) -> SolvedSegment:
        """Sort the frames by their place in the drive: the base may be the later segment, or lie around."""
        base, other = self.both
        opened = moved_rigidly(other.open_poses, other.poses[0], bundle.poses[self.first])
        rows = np.concatenate([segment.rows for segment in self.both])
        order = np.argsort(rows)
        place = np.argsort(order)
        breaks = self.breaks.copy()
        breaks[0] = True
        bundle = replace(bundle, poses=bundle.poses[order], tilt=bundle.tilt[order])
        road = replace(road, edges=[road.edges[i] for i in order])
        return replace(
            base,
            rows=rows[order],
            scans=road.scans(self.camera, bundle.tilt),
            trajectory=_one_of_both(base.trajectory, other.trajectory, order),
            open_poses=np.concatenate([base.open_poses, opened])[order],
            poses=bundle.poses,
            revisits=[replace(r, earlier=int(place[r.earlier]), later=int(place[r.later])) for r in revisits],
            bundle=bundle,
            breaks=breaks[order] & (np.arange(len(rows)) > 0),
            keys=None if self.keys is None else np.sort(place[self.keys]),
        )


def _alike_frames(
    base: Float[np.ndarray, "n d"], other: Float[np.ndarray, "m d"], min_similarity: float, max_pairs: int
) -> list[tuple[int, int]]:
    """Pairs of frames, one of either segment, that look alike, each the other's most similar one.

    Args:
        base: Thumbnails of the first segment, see :func:`datagen.slam.loops.revisits.thumbnails`.
        other: Likewise of the second, whose frames count on from those of the first.
        min_similarity: Correlation of the thumbnails, averaged over a few frames.
        max_pairs: Pairs at most, spread over the second segment.
    """
    first = len(base)
    similarity = diagonal_mean(similarities(base, other))
    # What surrounds the last frames of one segment must not be taken from the other one.
    inner = similarity[: max(first - _EDGE, 0)]
    if not inner.size:
        return []
    pairs = []
    for k in range(_EDGE // 4, len(other)):
        earlier = int(inner[:, k].argmax())
        score = float(inner[earlier, k])
        if score < min_similarity or abs(int(similarity[earlier].argmax()) - k) > _MUTUAL:
            continue
        pairs.append((score, earlier, k))
    every = max(1.0, len(other) / max_pairs)
    return [(earlier, first + k) for earlier, k in best_of_each(pairs, every)]


def _agreeing(poses: Float[np.ndarray, "n 3"], first: int, found: list[Revisit], height_cm: float) -> _Shared:
    """Find the largest set of alignments that agree with one of them.

    Args:
        poses: Poses of both segments, each in its own map.
        first: First frame of the second segment.
        found: Alignments.
        height_cm: Height of the camera, which sets the scale.
    """
    other = poses[first:]
    path = path_lengths(other)
    best: list[Revisit] = []
    moved = other
    for one in found:
        # Where the frame would be in the base's map.
        carried = moved_rigidly(other, other[one.later - first], compose(poses[one.earlier], one.relative))
        kept = []
        for r in found:
            seen = relative_pose(poses[r.earlier], carried[r.later - first]) - r.relative
            between = abs(path[r.later - first] - path[one.later - first])
            near = float(np.hypot(seen[0], seen[1])) < AGREE_HEIGHTS * height_cm + AGREE_SHARE * between
            if near and abs(float(wrap_angle(seen[2:])[0])) < AGREE_RAD:
                turns = carried[r.later - first, 2] - poses[r.earlier, 2] - r.relative[2]
                kept.append(replace(r, turns=round(turns / (2.0 * np.pi))))
        if len(kept) > len(best):
            best, moved = kept, carried
    return best, moved


def _concatenated(a: Scans, b: Scans) -> Scans:
    starts = np.concatenate([a.starts, b.starts[1:] + a.starts[-1]])
    points, normals, weights = (
        np.concatenate([getattr(a, name), getattr(b, name)]) for name in ("points_cm", "normals", "weights")
    )
    return Scans(points, normals, weights, starts)


def _one_of_both(a: Trajectory, b: Trajectory, order: Int[np.ndarray, "n"]) -> Trajectory:
    columns = {x.name: np.concatenate([getattr(a, x.name), getattr(b, x.name)]) for x in fields(a)}
    return Trajectory(**{name: column[order] for name, column in columns.items()})
