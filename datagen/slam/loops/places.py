"""Revisits: frames that show the same place, and the relative pose between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.slam.filter.field import DirectionField
from datagen.slam.odometry.scans import Scans, thin_scan
from datagen.slam.odometry.stillness import SMALL_HEIGHT, SMALL_WIDTH, small_pictures
from lanenet.config import Settings
from lanenet.data.drives import Drive
from lanenet.geometry.frames import map_from_car, map_from_car_directions, wrap_angle
from lanenet.geometry.poses import path_lengths, relative_pose

#: Heading per lap that an open loop misses which is good.
_SMALL_DRIFT_RAD = 0.6
#: Frames to either side over which the likeness of a pair is averaged.
_DIAGONAL = 4
#: Frames whose likeness to all before them is held at once: that of all pairs of a long drive is too much.
_BLOCK = 256


class RevisitSettings(Settings):
    """When two frames count as one place. Lengths are in camera heights.

    Attributes:
        min_gap_heights: Path between the two visits at least.
        min_similarity: Correlation of the thumbnails, averaged over a few frames.
        max_drift_rad: Heading that the open loop may miss in one lap. Revisits that no common drift per
            length explains are not believed: rooms repeat, and one false revisit bends a whole map.
        drift_tolerance_rad: What a revisit may miss of the common drift, one lap later.
        min_revisits: Fewer revisits than this are not believed.
        min_match: Matched share of the edges once aligned.
        max_pairs: Pairs to verify at most, spread over the drive.
        pair_heights: A long drive may get more than these: one on so long a way.
        along_heights: Offset along the road between the two visits at most: the pictures are alike only
            within a fraction of a camera height, and the next dash of a dashed line is not much further.
        sideways_heights: Offset across the road at most.
        search_rad: Difference of heading at most.
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


def thumbnails(drive: Drive) -> Float[np.ndarray, "n d"]:
    """Return a small, contrast-normalised picture of each frame as a unit vector.

    The whole frame counts, also what stands above the road: walls and people tell places apart that have the
    same markings.
    """
    rows = np.empty((len(drive), SMALL_HEIGHT * SMALL_WIDTH), np.float32)
    for k, small in enumerate(small_pictures(drive)):
        flat = small - cv2.GaussianBlur(small, (0, 0), 6.0)
        # Less than a tenth of a gray level is rounding: blank pictures would be alike by it.
        rows[k] = flat.ravel() / max(float(np.linalg.norm(flat)), 2.0)
    return rows


def propose_revisits(
    thumbs: Float[np.ndarray, "n d"],
    poses: Float[np.ndarray, "n 3"],
    camera_height_cm: float,
    settings: RevisitSettings,
) -> list[tuple[int, int]]:
    """Propose pairs (earlier, later) that look alike and have a stretch of road between them.

    Similarity is averaged along the diagonal, so that a pair counts when its neighbours agree, and allows
    a sideways shift of the picture, because the car comes back with another heading.

    Args:
        thumbs: A picture per frame, see :func:`thumbnails`.
        poses: Open-loop trajectory, heading unwrapped.
        camera_height_cm: Sets the scale.
        settings: Bounds.
    """
    n, path = len(thumbs), path_lengths(poses)
    before, after = np.zeros(n, np.int64), np.zeros(n, np.int64)
    score, score_after = np.full(n, -1.0, np.float32), np.full(n, -1.0, np.float32)
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        # What is averaged reaches beyond the block; what comes after it is no earlier visit.
        first, last = max(start - _DIAGONAL, 0), min(stop + _DIAGONAL, n)
        wider = diagonal_mean(alike(thumbs[:last], thumbs[first:last]))
        similarity = wider[:stop, start - first : stop - first]
        apart = path[start:stop] - path[:stop, None]
        similarity[apart < settings.min_gap_heights * camera_height_cm] = -1.0
        before[start:stop], score[start:stop] = similarity.argmax(axis=0), similarity.max(axis=0)
        best_after = similarity.max(axis=1)
        higher = np.flatnonzero(best_after > score_after[:stop])
        score_after[higher], after[higher] = best_after[higher], start + similarity[higher].argmax(axis=1)
    pairs = [
        (float(score[later]), int(before[later]), later)
        for later in range(n)
        if score[later] >= settings.min_similarity and later == after[before[later]]
    ]
    # The best of each stretch of the drive, so that no corner takes all the pairs.
    stretch = max(1.0, n / max(settings.max_pairs, path[-1] / (settings.pair_heights * camera_height_cm)))
    best: dict[int, tuple[float, int, int]] = {}
    for pair in pairs:
        key = int(pair[2] / stretch)
        best[key] = max(best.get(key, pair), pair)
    return [(earlier, later) for _, earlier, later in sorted(best.values(), key=lambda p: p[2])]


def alike(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    """Correlation of each small picture with each other one, at the sideways shift at which it is highest."""
    picture = b.reshape(len(b), SMALL_HEIGHT, SMALL_WIDTH)
    similarity = np.full((len(a), len(b)), -1.0, np.float32)
    for shift in (-2, -1, 0, 1, 2):
        shifted = np.roll(picture, shift, axis=2).reshape(len(b), -1)
        np.maximum(similarity, a @ shifted.T, out=similarity)
    return similarity


def diagonal_mean(similarity: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Average over neighbouring frames of both drives: a pair counts when its neighbours agree."""
    kernel = np.eye(2 * _DIAGONAL + 1, dtype=np.float32)
    return np.asarray(cv2.filter2D(similarity, -1, kernel / len(kernel), borderType=cv2.BORDER_REPLICATE))


def consistent_revisits(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], settings: RevisitSettings
) -> list[tuple[list[Revisit], float]]:
    """Group the revisits by the drift of the heading that explains them, and count their whole turns.

    The open loop misses heading in proportion to its length, nearly: most of it is a camera that looks a
    little to the side, or a speed that is a little off. The drift is known up to whole turns per lap: a lap
    that turns once, and one that does not turn at all or turns the other way, explain the same revisits with
    another drift, and only the map that each gives can tell.

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
    # Later visits may skip laps: the shortest gaps are those of one lap.
    lap = float(np.median(between[between < 1.5 * np.percentile(between, 10)]))
    limit = settings.max_drift_rad / lap
    # What the drift varies by adds up over the laps.
    tolerance = settings.drift_tolerance_rad * np.sqrt(np.maximum(between / lap, 1.0))
    count = int(10.0 * limit * between.max() / settings.drift_tolerance_rad)
    rates = np.linspace(-limit, limit, 2 * count + 1)
    rest = wrap_angle(missed - rates[:, None] * between)
    explained = np.sum(np.exp(-0.5 * (rest / (0.5 * tolerance)) ** 2), axis=1)
    # Places that look alike may agree on a large drift by chance: a small one is tried whatever they say.
    small = np.where(np.abs(rates) * lap <= _SMALL_DRIFT_RAD, explained, -1.0)
    laps = np.maximum(np.rint(between / lap), 1.0).astype(int)
    found: list[tuple[list[Revisit], float]] = []
    for best in dict.fromkeys((int(np.argmax(explained)), int(np.argmax(small)))):
        expected, rest_of = rates[best] * between, rest[best]
        for _ in range(2):
            # The drift may grow or shrink on the way.
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


def match_places(
    scans: Scans,
    poses: Float[np.ndarray, "n 3"],
    pair: tuple[int, int],
    camera_height_cm: float,
    wheelbase_cm: float,
    settings: RevisitSettings,
    rng: np.random.Generator,
) -> Revisit | None:
    """Align the later visit's edges with a small map of the earlier one.

    A coarse search over offsets and headings on a coarse field, then two rounds of samples on finer ones.

    Returns:
        The revisit, or None where too few edges match.
    """
    earlier, later = pair
    origin = poses[earlier]
    near = range(max(0, earlier - 20), min(len(scans), earlier + 21))
    query = _submap(
        scans, poses, range(max(0, later - 4), min(len(scans), later + 5)), later, wheelbase_cm, rng
    )
    points, normals, trust = query
    if len(points) < 20:
        return None
    step = 0.15 * camera_height_cm
    reach = np.array([settings.along_heights, settings.sideways_heights]) * camera_height_cm
    along, sideways = (np.arange(-r, r + 1e-9, step) for r in reach)
    angles = np.arange(-settings.search_rad, settings.search_rad + 1e-9, np.deg2rad(3.0))
    grid = np.stack(np.meshgrid(along, sideways, angles, indexing="ij"), axis=-1).reshape(-1, 3)
    spread = np.array([step, step, np.deg2rad(2.0)])
    best, share = np.zeros(3), 0.0
    for cell_heights in (0.12, 0.06, 0.04):
        field = DirectionField.empty(cell_heights * camera_height_cm, 512, 1e9)
        for k in near:
            frame = scans.frame(k)
            pose = relative_pose(origin, poses[k])
            field.insert(
                map_from_car(scans.points_cm[frame], pose, wheelbase_cm),
                map_from_car_directions(scans.normals[frame], pose[2]),
                scans.weights[frame] / len(near),
                0,
            )
        # Cells were filled by many frames: bring the field to about one where all agree.
        field.vectors[...] *= 8.0
        scores = field.score(grid, wheelbase_cm, points, normals, trust, 0) / trust.sum()
        # Alike pictures were taken at about the same place: a weak prior settles ties between dashes.
        chosen = int(np.argmax(scores - 0.1 * np.sum((grid[:, :2] / reach) ** 2, axis=1)))
        best, share = grid[chosen], float(scores[chosen])
        grid = best + rng.normal(size=(600, 3)) * spread
        grid[0] = best
        spread = spread * 0.35
    return Revisit(earlier, later, best, share) if share >= settings.min_match else None


def _submap(
    scans: Scans,
    poses: Float[np.ndarray, "n 3"],
    frames: range,
    reference: int,
    wheelbase_cm: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Float[np.ndarray, "m"]]:
    """Edges of several frames as points of the reference frame's car frame."""
    parts = []
    for k in frames:
        points, normals, trust = thin_scan(scans, k, 60, rng)
        pose = relative_pose(poses[reference], poses[k])
        ahead_left = map_from_car(points, pose, wheelbase_cm)
        directions = map_from_car_directions(normals, pose[2])
        # Back to x right, y ahead of the front axle.
        car = np.stack([-ahead_left[:, 1], ahead_left[:, 0] - wheelbase_cm], axis=1)
        parts.append((car, np.stack([-directions[:, 1], directions[:, 0]], axis=1), trust))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))  # type: ignore[return-value]
