"""Revisits: frames that show the same place, and the relative pose between them.

The relative pose is found on a likelihood field: blurred unit normals of the mapped edges, scored by dot
product. A count of matched points prefers standing still; with directions, an edge only matches an edge that
brightens in the same direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from numba import njit
from pydantic import Field

from datagen.slam.commands import BREAK_PERIODS
from datagen.slam.odometry.scans import Scan, Scans, thin_scan
from datagen.slam.odometry.stillness import SMALL_HEIGHT, SMALL_WIDTH, small_images
from lanenet.config import Settings
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car, map_from_car_directions, wrap_angle
from lanenet.geometry.poses import compose, path_lengths, relative_pose
from lanenet.processes import in_threads

#: Blur, in pixels of a small image, that is taken off for contrast, and the least length of what is left,
#: gray levels: less than a tenth of a gray level per pixel is rounding, by which blank images would be alike.
_CONTRAST_PX, _LEAST_CONTRAST = 6.0, 2.0
#: Sideways shifts, in pixels of a small image, that are tried, since the car comes back with another heading:
#: a pixel is about 5 degrees.
_SHIFTS = (-2, -1, 0, 1, 2)
#: Difference of the headings of an open loop, modulo whole turns, up to which frames may look the same way.
#: Chosen: half a corner of a ring of tiles.
_SAME_WAY_RAD = 0.25 * np.pi
#: Frames to either side over which the similarity of a pair is averaged.
_DIAGONAL = 4
#: Frames by which the later visit may miss being the one most similar to the earlier: its neighbours are as
#: similar, nearly. Measured on ``garage_tape`` and ``donkey_circuit`` with gaps: 3 instead of 0 gave a fifth
#: more true revisits, at the same share of false ones.
_MUTUAL = 3
#: How far from a known revisit others are proposed by their place, in the spacing of pairs. Chosen: two or
#: three frames on each side.
_WITHIN_REACH = 3.0
#: Frames whose similarity to all before them is held at once: that of all pairs of a long drive is too much.
_BLOCK = 256
#: Frames to either side that make the map of the earlier visit and the edges of the later one: the first must
#: reach as far as the second may be off. Edge points per frame of the latter, and the fewest of them all.
_MAP_FRAMES, _QUERY_FRAMES, _QUERY_POINTS, _LEAST_POINTS = 20, 4, 60, 20
#: Of frames that see the same road from both sides: their distance, the largest offset along the road, and
#: the path behind the turn on which they are sought, in camera heights; frames to either side that make the
#: map of the earlier one. Chosen: where each sees best; as far as a car is carried when it is turned round; a
#: corridor and the corner behind it; what the offset reaches.
_FACING_HEIGHTS, _CARRIED_HEIGHTS, _TURNED_HEIGHTS, _TURNED_FRAMES = 6.0, 8.0, 60.0, 60
#: Share of the best match that frames facing each other may have elsewhere along the road: a straight, or
#: dashes, look alike all along. Measured on two office drives: 0.30 to 0.89 where they were right, 0.93 to
#: 1.0 where they were off by some dashes.
_AS_WELL = 0.9
#: The search: cells of the field in camera heights, coarse to fine; the grid's spacing in camera heights and
#: degrees; the sigma of the samples about its best heading, degrees, by how much it shrinks, and their
#: number. Chosen: the spacing is about a cell of the coarsest field.
_CELLS_HEIGHTS, _GRID_HEIGHTS, _GRID_DEG = (0.12, 0.06, 0.04), 0.15, 3.0
_SAMPLE_DEG, _SHRINK, _SAMPLES = 2.0, 0.35, 600
#: The grid is scored with one point in so many first, and then so many of its best poses with all. Chosen: a
#: twelfth of the grid; on 89 pairs of ``donkey_circuit`` and ``garage_tape`` it held the best pose each time.
_EVERY_POINT, _BEST_POSES = 4, 500
#: Cells along each side of the field: 20 camera heights at the finest, more than the frames around see.
_FIELD_SIZE = 512
#: The field is an average over frames that do not quite agree: this brings it to about one where they do.
_FIELD_GAIN = 8.0
#: Weight of the prior that similar images were taken at about the same place. Weak: it only settles ties
#: between dashes.
_PLACE_PRIOR = 0.1
#: Cells on each side of a point that it blurs into: two standard deviations of the blur, which is one cell.
_REACH = 2
#: Type of an index: unsigned, so that numba need not check for indices from the end.
U = np.uint32


class RevisitSettings(Settings):
    """When two frames count as one place. Lengths are in camera heights.

    Values were chosen on ``donkey_circuit``, ``usi_mat`` and ``garage_tape`` and on simulated drives
    (docs/mapping.md).

    Attributes:
        min_gap_heights: Least path between the two visits: less than the shortest lap of a track.
        min_similarity: Correlation of the thumbnails, averaged over a few frames.
        max_drift_rad: Heading that the open loop may miss in one lap. Revisits that no common drift explains
            are not believed: rooms repeat, and one false revisit bends a whole map.
        drift_tolerance_rad: What a revisit may miss of the common drift, one lap later.
        min_revisits: Fewer revisits than this are not believed.
        min_match: Matched share of the edges once aligned.
        max_pairs: Pairs to verify at most, spread over the drive.
        pair_heights: A long drive may get more than these: one per so much path.
        along_heights: Largest offset along the road between the two visits. Images are similar only within a
            fraction of a camera height, and the next dash of a dashed line is not much further.
        sideways_heights: Largest offset across the road: about a lane.
        search_rad: Largest difference of heading.
    """

    min_gap_heights: float = Field(default=20.0, gt=0.0)
    min_similarity: float = Field(default=0.6, gt=0.0, lt=1.0)
    max_drift_rad: float = Field(default=5.0, gt=0.0)
    drift_tolerance_rad: float = Field(default=0.45, gt=0.0)
    min_revisits: int = Field(default=3, ge=1)
    min_match: float = Field(default=0.35, gt=0.0, lt=1.0)
    max_pairs: int = Field(default=60, ge=1)
    pair_heights: float = Field(default=4.0, gt=0.0)
    along_heights: float = Field(default=0.9, gt=0.0)
    sideways_heights: float = Field(default=2.0, gt=0.0)
    search_rad: float = Field(default=0.45, gt=0.0)


@dataclass(frozen=True)
class Revisit:
    """Frame ``later`` shows the place of frame ``earlier``.

    Attributes:
        relative: Pose of the later frame in the rear-axle frame of the earlier (x ahead, y left).
        match: Matched share of the later frame's edges.
        turns: Whole turns to the left between the two.
    """

    earlier: int
    later: int
    relative: Float[np.ndarray, "3"]
    match: float
    turns: int = 0

    @property
    def faces(self) -> bool:
        """Whether the frames face each other: they see the same road from both sides."""
        return bool(abs(self.relative[2]) > 0.5 * np.pi)


def thumbnails(drive: Drive) -> Float[np.ndarray, "n d"]:
    """Return a small, contrast-normalised image of each frame as a unit vector.

    The whole frame counts, also what is above the road: walls and people tell places apart that have the same
    markings.
    """
    rows = np.empty((len(drive), SMALL_HEIGHT * SMALL_WIDTH), np.float32)
    for k, small in enumerate(small_images(drive)):
        flat = small - cv2.GaussianBlur(small, (0, 0), _CONTRAST_PX)
        rows[k] = flat.ravel() / max(float(np.linalg.norm(flat)), _LEAST_CONTRAST)
    return rows


def propose_revisits(
    thumbs: Float[np.ndarray, "n d"],
    poses: Float[np.ndarray, "n 3"],
    periods: Float[np.ndarray, "n"],
    camera_height_cm: float,
    settings: RevisitSettings,
) -> list[tuple[int, int]]:
    """Propose pairs (earlier, later) of frames that are similar and have enough path between them.

    Of each frame the most similar earlier one, and the most similar one of those that the open loop has at
    the same heading: where all corners look alike, the first is seldom the true one.

    Args:
        thumbs: See :func:`thumbnails`.
        poses: Open-loop trajectory, heading unwrapped.
        periods: Time from the frame before to each frame, in typical time steps. Every run without any gap
            gets a pair of its own; across a break, after which the car may be anywhere, no path is asked for.
        camera_height_cm: Sets the scale.
        settings: Bounds.
    """
    n, path, heading = len(thumbs), path_lengths(poses), poses[:, 2]
    run, recording = np.cumsum(periods > 1.0), np.cumsum(periods >= BREAK_PERIODS)
    alike, turned_alike = _MostSimilar.of(n), _MostSimilar.of(n)
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        # Averaging reaches beyond the block; frames after it are no earlier visits.
        first, last = max(start - _DIAGONAL, 0), min(stop + _DIAGONAL, n)
        wider = diagonal_mean(similarities(thumbs[:last], thumbs[first:last]))
        similarity = wider[:stop, start - first : stop - first]
        apart = path[start:stop] - path[:stop, None]
        near = apart < settings.min_gap_heights * camera_height_cm
        unbroken = recording[start:stop] == recording[:stop, None]
        later = np.arange(start, stop) > np.arange(stop)[:, None]
        similarity[(near & unbroken) | ~later] = -1.0
        alike.look(similarity, start)
        turned = np.abs(wrap_angle(heading[start:stop] - heading[:stop, None]))
        turned_alike.look(np.where(unbroken & (turned > _SAME_WAY_RAD), -1.0, similarity), start)
    most = max(settings.max_pairs, path[-1] / (settings.pair_heights * camera_height_cm))
    # The most similar pairs of every so many frames, so that no corner takes all the pairs.
    frames = max(1.0, n / most)
    best: dict[tuple[int, int, bool], tuple[float, int, int]] = {}
    for found in (alike, turned_alike):
        for pair in found.pairs(settings):
            key = int(run[pair[2]]), int(pair[2] / frames), found is alike
            best[key] = max(best.get(key, pair), pair)
    return sorted({(earlier, later) for _, earlier, later in best.values()}, key=lambda pair: pair[::-1])


class _MostSimilar(NamedTuple):
    """The most similar earlier frame of each frame, and the most similar later one, with their similarities.

    Attributes:
        before: The earlier frame.
        score: Its similarity.
        after: The later frame.
        score_after: Its similarity.
    """

    before: Int[np.ndarray, "n"]
    score: Float32[np.ndarray, "n"]
    after: Int[np.ndarray, "n"]
    score_after: Float32[np.ndarray, "n"]

    @classmethod
    def of(cls, n: int) -> _MostSimilar:
        """Return the state before any frame was looked at."""
        frames, least = np.zeros(n, np.int64), np.full(n, -1.0, np.float32)
        return cls(frames, least, frames.copy(), least.copy())

    def look(self, similarity: Float32[np.ndarray, "e l"], start: int) -> None:
        """Take in the similarities of the frames from ``start`` on (columns) to all before them (rows)."""
        stop = start + similarity.shape[1]
        self.before[start:stop], self.score[start:stop] = similarity.argmax(axis=0), similarity.max(axis=0)
        best_after = similarity.max(axis=1)
        higher = np.flatnonzero(best_after > self.score_after[: len(best_after)])
        self.score_after[higher] = best_after[higher]
        self.after[higher] = start + similarity[higher].argmax(axis=1)

    def pairs(self, settings: RevisitSettings) -> list[tuple[float, int, int]]:
        """Similarity, earlier and later frame of the pairs that are most similar both ways."""
        return [
            (float(self.score[later]), int(self.before[later]), later)
            for later in range(len(self.score))
            if self.score[later] >= settings.min_similarity
            and abs(later - self.after[self.before[later]]) <= _MUTUAL
        ]


def propose_beside(
    poses: Float[np.ndarray, "n 3"],
    periods: Float[np.ndarray, "n"],
    known: Sequence[Revisit],
    camera_height_cm: float,
    settings: RevisitSettings,
) -> list[tuple[int, int]]:
    """Propose pairs (earlier, later) of frames that closed poses have at about the same place.

    Images of one place need not be similar: the car may look another way, or light and people have changed.
    Where no known revisit holds a section, a frame in every so much path from the next one is paired with the
    nearest one of another visit, and with the one that faces it. Further on, the open loop may have drifted
    away from its true place.

    Args:
        poses: Poses after closing loops.
        periods: Time from the frame before to each frame, in typical time steps.
        known: Revisits by which they were closed.
        camera_height_cm: Sets the scale.
        settings: Bounds.
    """
    if not known:
        return []
    path, recording = path_lengths(poses), np.cumsum(periods >= BREAK_PERIODS)
    spacing_cm = settings.pair_heights * camera_height_cm
    held_cm = np.array([path[frame] for r in known for frame in (r.earlier, r.later)])
    reach = np.array([settings.along_heights, settings.sideways_heights]) * camera_height_cm
    pairs = []
    cells = np.unique((path / spacing_cm).astype(np.int64), return_index=True)[1]
    for frame in cells.tolist():
        if not spacing_cm <= np.abs(held_cm - path[frame]).min() < _WITHIN_REACH * spacing_cm:
            continue
        other = (np.abs(path - path[frame]) > settings.min_gap_heights * camera_height_cm) | (
            recording != recording[frame]
        )
        for place in (poses[frame], facing(poses[frame], camera_height_cm)):
            off = relative_pose(np.broadcast_to(place, poses.shape), poses)
            near = other & (np.abs(off[:, :2]) < reach).all(axis=1)
            near &= np.abs(wrap_angle(off[:, 2])) < settings.search_rad
            if near.any():
                apart = np.where(near, np.sum((off[:, :2] / reach) ** 2, axis=1), np.inf)
                partner = int(np.argmin(apart))
                pairs.append((min(frame, partner), max(frame, partner)))
    return sorted(set(pairs))


def facing(pose: Float[np.ndarray, "3"], camera_height_cm: float) -> Float[np.ndarray, "3"]:
    """Return the pose from which a car sees the same road from the other side."""
    return compose(pose, np.array([_FACING_HEIGHTS * camera_height_cm, 0.0, np.pi]))


def propose_turned(
    poses: Float[np.ndarray, "n 3"],
    part: Int[np.ndarray, "n"],
    camera_height_cm: float,
    settings: RevisitSettings,
) -> list[tuple[int, int, Float[np.ndarray, "3"]]]:
    """Propose pairs (earlier, later) of frames that face each other, were the car turned round at a break.

    Their images have nothing in common, but the road between them is the same, seen from both sides.

    Args:
        poses: Open-loop trajectory.
        part: Part of the drive that each frame belongs to.
        camera_height_cm: Sets the scale.
        settings: Bounds; parts that are shorter than ``min_gap_heights`` are left out.

    Returns:
        The pairs, each with the pose of the later frame in the rear-axle frame of the earlier if the car was
        turned on the spot.
    """
    path, proposed = path_lengths(poses), []
    # A corner is short, and little else tells where along the road the car is.
    facing_cm, spacing_cm = (h * camera_height_cm for h in (_FACING_HEIGHTS, 0.5 * settings.pair_heights))
    for last in np.flatnonzero(np.diff(part)).tolist():
        first, stop = np.searchsorted(part, part[last]), np.searchsorted(part, part[last + 1], "right")
        shorter_cm = min(path[last] - path[first], path[stop - 1] - path[last + 1])
        if shorter_cm < settings.min_gap_heights * camera_height_cm:
            continue
        most_cm = min(shorter_cm - facing_cm, _TURNED_HEIGHTS * camera_height_cm)
        for gone_cm in np.arange(spacing_cm, most_cm, spacing_cm):
            later = int(np.searchsorted(path, path[last + 1] + gone_cm))
            earlier, mirrored = np.searchsorted(path, path[last] - gone_cm - np.array([facing_cm, 0.0]))
            turned = poses[mirrored] + [0.0, 0.0, np.pi]
            proposed.append((int(earlier), later, relative_pose(poses[earlier], turned)))
    return proposed


def similarities(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    """Correlation of all thumbnails with all others, at the sideways shift at which it is highest."""
    images = b.reshape(len(b), SMALL_HEIGHT, SMALL_WIDTH)
    similarity = np.full((len(a), len(b)), -1.0, np.float32)
    for shift in _SHIFTS:
        shifted = np.roll(images, shift, axis=2).reshape(len(b), -1)
        np.maximum(similarity, a @ shifted.T, out=similarity)
    return similarity


def diagonal_mean(similarity: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Average over neighbouring frames of both visits: a pair counts when its neighbours agree."""
    kernel = np.eye(2 * _DIAGONAL + 1, dtype=np.float32)
    return np.asarray(cv2.filter2D(similarity, -1, kernel / len(kernel), borderType=cv2.BORDER_REPLICATE))


class PlaceMatcher:
    """Aligns the edges of a later visit with a small map of the earlier one."""

    def __init__(
        self,
        scans: Scans,
        poses: Float[np.ndarray, "n 3"],
        part: Int[np.ndarray, "n"],
        camera: Camera,
        settings: RevisitSettings,
    ) -> None:
        """Take what all pairs share.

        Args:
            scans: Edge points per frame.
            poses: Open-loop trajectory, heading unwrapped.
            part: Part of the drive that each frame belongs to; frames of another part are not beside it.
            camera: Its height sets the scale.
            settings: Bounds.
        """
        self.scans, self.poses, self.part, self.settings = scans, poses, part, settings
        self.height_cm, self.wheelbase_cm = camera.mounting.height_cm, camera.wheelbase_cm

    def matched(
        self,
        pairs: Iterable[tuple[int, int]],
        rng: np.random.Generator,
        closed: Float[np.ndarray, "n 3"] | None = None,
    ) -> list[Revisit]:
        """Align all pairs; those of which too few edges match are left out.

        Args:
            pairs: The pairs.
            rng: Draws edge points and samples.
            closed: Poses by which frames that face each other are found; None where none do.
        """
        jobs = []
        for earlier, later in pairs:
            about = np.zeros(3) if closed is None else relative_pose(closed[earlier], closed[later])
            jobs.append((earlier, later, about if abs(about[2]) > 0.5 * np.pi else np.zeros(3)))
        return self._all(jobs, rng, None, _MAP_FRAMES)

    def turned(
        self, proposed: Sequence[tuple[int, int, Float[np.ndarray, "3"]]], rng: np.random.Generator
    ) -> list[Revisit]:
        """Align the pairs of :func:`propose_turned`."""
        return self._all(proposed, rng, _CARRIED_HEIGHTS, _TURNED_FRAMES)

    def _all(
        self,
        proposed: Sequence[tuple[int, int, Float[np.ndarray, "3"]]],
        rng: np.random.Generator,
        along_heights: float | None,
        frames: int,
    ) -> list[Revisit]:
        """Align pairs in threads, each with a generator of its own, so that their order does not count."""

        def aligned(
            job: tuple[tuple[int, int, Float[np.ndarray, "3"]], np.random.Generator],
        ) -> Revisit | None:
            (earlier, later, about), own_rng = job
            return self.match((earlier, later), own_rng, about, along_heights, frames)

        found = in_threads(aligned, zip(proposed, rng.spawn(len(proposed)), strict=True))
        return [revisit for revisit in found if revisit is not None]

    def match(
        self,
        pair: tuple[int, int],
        rng: np.random.Generator,
        about: Float[np.ndarray, "3"] | None = None,
        along_heights: float | None = None,
        frames: int = _MAP_FRAMES,
    ) -> Revisit | None:
        """Align two visits: a search over a grid on a coarse field, then two rounds of samples on finer ones.

        Args:
            pair: The earlier and the later frame.
            rng: Draws edge points and samples.
            about: Where the later frame is sought, in the rear-axle frame of the earlier; None for its place.
            along_heights: Largest offset along the road; None for that of the settings. Where it is large,
                a road that looks alike all along gives none.
            frames: Frames to either side that make the map of the earlier visit.

        Returns:
            The revisit, or None where too few edges match.
        """
        earlier, later = pair
        s, height_cm = self.settings, self.height_cm
        query = self._submap(self._around(later, _QUERY_FRAMES), later, rng)
        if len(query.weights) < _LEAST_POINTS:
            return None
        about = np.zeros(3) if about is None else about
        near, step = self._around(earlier, frames), _GRID_HEIGHTS * height_cm
        reach = np.array([along_heights or s.along_heights, s.sideways_heights]) * height_cm
        along, sideways = (np.arange(-r, r + 1e-9, step) for r in reach)
        angles = np.arange(-s.search_rad, s.search_rad + 1e-9, np.deg2rad(_GRID_DEG))
        tried = about + np.stack(np.meshgrid(along, sideways, angles, indexing="ij"), axis=-1).reshape(-1, 3)
        spread = np.array([step, step, np.deg2rad(_SAMPLE_DEG)])
        best, share = about, 0.0
        for cell_heights in _CELLS_HEIGHTS:
            field = DirectionField.empty(cell_heights * height_cm, _FIELD_SIZE)
            for k in near:
                scan, pose = self.scans.scan(k), relative_pose(self.poses[earlier], self.poses[k])
                field.insert(
                    map_from_car(scan.points_cm, pose, self.wheelbase_cm),
                    map_from_car_directions(scan.normals, pose[2]),
                    scan.weights / len(near),
                )
            field.vectors[...] *= _FIELD_GAIN
            prior = _PLACE_PRIOR * np.sum(((tried - about)[:, :2] / reach) ** 2, axis=1)
            if len(tried) > _SAMPLES:
                few = Scan(*(column[::_EVERY_POINT] for column in query))
                rough = self._shares(field, tried, few) - prior
                off_cm = np.abs(tried[:, 0] - tried[int(rough.argmax()), 0])
                if along_heights and rough[off_cm > height_cm].max() > _AS_WELL * rough.max():
                    return None
                kept = np.argpartition(-rough, _BEST_POSES)[:_BEST_POSES]
                tried, prior = tried[kept], prior[kept]
            scores = self._shares(field, tried, query)
            chosen = int(np.argmax(scores - prior))
            best, share = tried[chosen], float(scores[chosen])
            tried = best + rng.normal(size=(_SAMPLES, 3)) * spread
            tried[0] = best
            spread = spread * _SHRINK
        return Revisit(earlier, later, best, share) if share >= s.min_match else None

    def _shares(
        self, field: DirectionField, poses: Float[np.ndarray, "p 3"], query: Scan
    ) -> Float[np.ndarray, "p"]:
        """Matched share of a visit's edges at each pose."""
        return field.score(poses, self.wheelbase_cm, query) / query.weights.sum()

    def _around(self, frame: int, frames: int) -> range:
        """Frames of the same part within so many of one."""
        first, stop = (int(np.searchsorted(self.part, self.part[frame], side)) for side in ("left", "right"))
        return range(max(first, frame - frames), min(stop, frame + frames + 1))

    def _submap(self, frames: range, reference: int, rng: np.random.Generator) -> Scan:
        """Edges of several frames as points of the reference frame's car frame."""
        parts = []
        for k in frames:
            points, normals, weights = thin_scan(self.scans.scan(k), _QUERY_POINTS, rng)
            pose = relative_pose(self.poses[reference], self.poses[k])
            ahead_left = map_from_car(points, pose, self.wheelbase_cm)
            directions = map_from_car_directions(normals, pose[2])
            # Back to x right, y ahead of the front axle.
            car = np.stack([-ahead_left[:, 1], ahead_left[:, 0] - self.wheelbase_cm], axis=1)
            parts.append((car, np.stack([-directions[:, 1], directions[:, 0]], axis=1), weights))
        return Scan(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class DirectionField(NamedTuple):
    """A wrapping grid of blurred unit vectors: a cell holds the patch of road that was mapped there last.

    Attributes:
        cell_cm: Side of a cell.
        vectors: Sum of unit normals per cell, size x size x 2.
        owner: Which cell of the unbounded plane (ix, iy) each grid cell holds.
        mapped: Whether the cell holds anything.
    """

    cell_cm: float
    vectors: Float32[np.ndarray, "s s 2"]
    owner: Int32[np.ndarray, "s s 2"]
    mapped: Bool[np.ndarray, "s s"]

    @staticmethod
    def empty(cell_cm: float, size: int) -> DirectionField:
        """Return an empty field; ``size`` must be a power of two."""
        return DirectionField(
            cell_cm,
            np.zeros((size, size, 2), np.float32),
            np.zeros((size, size, 2), np.int32),
            np.zeros((size, size), np.bool_),
        )

    def insert(
        self,
        points_map_cm: Float[np.ndarray, "n 2"],
        normals_map: Float[np.ndarray, "n 2"],
        weights: Float[np.ndarray, "n"],
    ) -> None:
        """Map edge points, [cm], frame map."""
        _insert(self, points_map_cm, normals_map, weights)

    def score(
        self, poses: Float[np.ndarray, "p 3"], wheelbase_cm: float, scan: Scan
    ) -> Float[np.ndarray, "p"]:
        """Score how well a frame's edges fit the map from each pose.

        Returns:
            Weighted sum over the points of normal . field, one number per pose; about the weighted number
            of matched points.
        """
        return np.asarray(_score(self, poses, wheelbase_cm, scan))


@njit(cache=True, fastmath=True, nogil=True)
@no_type_check
def _insert(field, points, normals, weights):
    vectors, owner, mapped, cell_cm = field.vectors, field.owner, field.mapped, field.cell_cm
    mask = vectors.shape[0] - 1
    for i in range(points.shape[0]):
        gx, gy = points[i, 0] / cell_cm, points[i, 1] / cell_cm
        cx, cy = int(np.floor(gx)), int(np.floor(gy))
        for iy in range(cy - _REACH, cy + _REACH + 1):
            for ix in range(cx - _REACH, cx + _REACH + 1):
                dx, dy = ix + 0.5 - gx, iy + 0.5 - gy
                w = weights[i] * np.exp(-0.5 * (dx * dx + dy * dy))
                a, b = U(iy & mask), U(ix & mask)
                if not mapped[a, b] or owner[a, b, 0] != ix or owner[a, b, 1] != iy:
                    owner[a, b, 0], owner[a, b, 1] = ix, iy
                    vectors[a, b, 0] = 0.0
                    vectors[a, b, 1] = 0.0
                    mapped[a, b] = True
                vectors[a, b, 0] += w * normals[i, 0]
                vectors[a, b, 1] += w * normals[i, 1]


@njit(cache=True, fastmath=True, nogil=True)
@no_type_check
def _score(field, poses, wheelbase, scan):
    vectors, owner, mapped, cell_cm = field.vectors, field.owner, field.mapped, field.cell_cm
    points, normals, weights = scan.points_cm, scan.normals, scan.weights
    mask = vectors.shape[0] - 1
    scores = np.zeros(poses.shape[0])
    for p in range(poses.shape[0]):
        c, s = np.cos(poses[p, 2]), np.sin(poses[p, 2])
        total = 0.0
        for i in range(points.shape[0]):
            forward, right = points[i, 1] + wheelbase, points[i, 0]
            gx = (poses[p, 0] + forward * c + right * s) / cell_cm - 0.5
            gy = (poses[p, 1] + forward * s - right * c) / cell_cm - 0.5
            nx = normals[i, 1] * c + normals[i, 0] * s
            ny = normals[i, 1] * s - normals[i, 0] * c
            ix, iy = int(np.floor(gx)), int(np.floor(gy))
            tx, ty = gx - ix, gy - iy
            vx, vy = 0.0, 0.0
            for jy in range(2):
                wy = ty if jy else 1.0 - ty
                for jx in range(2):
                    a, b = U((iy + jy) & mask), U((ix + jx) & mask)
                    if mapped[a, b] and owner[a, b, 0] == ix + jx and owner[a, b, 1] == iy + jy:
                        w = wy * (tx if jx else 1.0 - tx)
                        vx += w * vectors[a, b, 0]
                        vy += w * vectors[a, b, 1]
            # Saturate: an edge that was seen often counts once.
            total += weights[i] * (nx * vx + ny * vy) / (1.0 + np.sqrt(vx * vx + vy * vy))
        scores[p] = total
    return scores
