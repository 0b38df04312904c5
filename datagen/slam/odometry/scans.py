"""Scans: the edge points of every frame on the road, packed for the numba kernels, and reduced to fewer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit

from datagen.slam.odometry.likely import likely_markings
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadEdges, RoadTable
from lanenet.processes import in_threads

Progress = Callable[[int, int], None]

#: Directions that :func:`condense` keeps apart: enough for the two edges of a tape.
_SECTORS = 4
#: Distance at which a point weighs one half, camera heights. Chosen: lines that were seen only beyond 3.5
#: camera heights were wrong on ``donkey_circuit``.
_HALF_WEIGHT_HEIGHTS = 4.0
#: Frames that are dealt with at once. Chosen: more only takes more memory.
_AT_ONCE = 64


class Scan(NamedTuple):
    """Edge points of one frame.

    Attributes:
        points_cm: Edge points, frame car.
        normals: Unit vectors across the edges, towards the brighter side, frame car.
        weights: Trust in each point.
    """

    points_cm: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]
    weights: Float[np.ndarray, "m"]


@dataclass(frozen=True)
class Scans:
    """Edge points of all frames in one array.

    Attributes:
        points_cm: Edge points, frame car, all frames one after the other.
        normals: Unit vectors across the edges, towards the brighter side, frame car.
        weights: Trust in each point: 1 near the car, falling with the road that one pixel spans.
        starts: Index of the first point of each frame, with the total at the end.
    """

    points_cm: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]
    weights: Float[np.ndarray, "m"]
    starts: Int[np.ndarray, "n1"]

    def __len__(self) -> int:
        return len(self.starts) - 1

    def frame(self, k: int) -> slice:
        """Return the slice of frame k's points."""
        return slice(int(self.starts[k]), int(self.starts[k + 1]))

    def scan(self, k: int) -> Scan:
        """Return frame k's edge points."""
        rows = self.frame(k)
        return Scan(self.points_cm[rows], self.normals[rows], self.weights[rows])

    def only(self, frames: Int[np.ndarray, "k"]) -> Scans:
        """Return the scans of some frames, in that order."""
        chosen = [np.arange(self.starts[k], self.starts[k + 1]) for k in frames]
        rows = np.concatenate(chosen) if len(chosen) else np.zeros(0, np.int64)
        starts = np.concatenate([[0], np.cumsum([len(one) for one in chosen])]).astype(np.int64)
        return Scans(self.points_cm[rows], self.normals[rows], self.weights[rows], starts)

    @property
    def frame_of_point(self) -> Int[np.ndarray, "m"]:
        """Frame index of every point."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))


def edges_of_drive(drive: Drive, settings: EdgeSettings, table: RoadTable) -> list[EdgePixels]:
    """Find the edge pixels of every frame that see the road; on a textured floor, the likeliest markings."""

    def edges_of(image: UInt8[np.ndarray, "h w *c"]) -> EdgePixels:
        return likely_markings(find_edges(image, settings, table.keep, table.scale, table.sample), table.keep)

    found: list[EdgePixels] = []
    for first in range(0, len(drive), _AT_ONCE):
        # Read here: not every source of images can be read from several threads.
        images = [drive.image(k) for k in range(first, min(first + _AT_ONCE, len(drive)))]
        found += in_threads(edges_of, images)
    return found


def scans_of(
    edges: list[EdgePixels],
    camera: Camera,
    range_settings: RangeSettings,
    tilt_rad: Float[np.ndarray, "n 2"] | None = None,
) -> Scans:
    """Move the edge pixels of all frames to the road.

    Args:
        edges: Edge pixels per frame.
        camera: The camera.
        range_settings: Which part of the road counts.
        tilt_rad: Pitch and roll of each frame beyond the mounting's; None for level.
    """
    table = RoadTable(camera, range_settings)
    kept = [seen_edges(pixels, table) for pixels in edges]
    if tilt_rad is None:
        frames = [table.lift(pixels) for pixels in kept]
    else:
        parts = [slice(first, first + _AT_ONCE) for first in range(0, len(kept), _AT_ONCE)]
        lifted = in_threads(lambda part: lift_tilted(kept[part], camera, tilt_rad[part]), parts)
        frames = [road for part in lifted for road in part]
    return pack_scans(frames, camera.mounting.height_cm, camera.mounting.lead_cm)


def seen_edges(pixels: EdgePixels, table: RoadTable) -> EdgePixels:
    """Return the edge pixels that see the part of the road that counts."""
    nearest = np.rint(pixels.uv_px).astype(np.intp)
    seen = table.keep[nearest[:, 1], nearest[:, 0]] > 0
    return EdgePixels(pixels.uv_px[seen], pixels.normals[seen])


def lift_tilted(
    frames: Sequence[EdgePixels], camera: Camera, tilt_rad: Float[np.ndarray, "n 2"]
) -> list[RoadEdges]:
    """Lift the edges of some frames with the camera as it was tilted in each."""
    m = camera.mounting
    counts = [len(pixels.uv_px) for pixels in frames]
    starts = np.cumsum([0, *counts])
    uv = np.concatenate([pixels.uv_px for pixels in frames])
    normals = np.concatenate([pixels.normals for pixels in frames])
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    # The rays of all frames at once, for a call costs as much as hundreds of them; then frame by frame.
    rays = camera.unproject(np.concatenate([uv, uv + 0.5 * along, uv + 0.5 * normals])).reshape(3, -1, 3)
    for frame, (pitch_rad, roll_rad) in enumerate(tilt_rad.tolist()):
        tilted = replace(
            m, pitch_down_rad=m.pitch_down_rad + pitch_rad, roll_rad=m.roll_rad + roll_rad
        ).camera_from_car
        own = slice(starts[frame], starts[frame + 1])
        rays[:, own] = rays[:, own] @ tilted
    road = camera.meet_ground(rays.reshape(-1, 3)).reshape(3, -1, 2)
    tangent, towards = road[1] - road[0], road[2] - road[0]
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    # The normal that points to the brighter side.
    across *= np.where(np.sum(across * towards, axis=1) < 0.0, -1.0, 1.0)[:, None]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    good = np.isfinite(road[0]).all(axis=1) & np.isfinite(across).all(axis=1)
    ends = np.concatenate([[0], np.cumsum(good)])[starts]
    points, across = road[0][good], across[good]
    return [RoadEdges(points[a:b], across[a:b]) for a, b in pairwise(ends.tolist())]


def distances_seen(points_cm: Float[np.ndarray, "m 2"], lead_cm: float) -> Float[np.ndarray, "m"]:
    """Distances of points from the front axle, or from the foot of a camera that is further ahead.

    Args:
        points_cm: Points, frame car.
        lead_cm: Of the camera, see :attr:`lanenet.geometry.camera.Mounting.lead_cm`.
    """
    return np.hypot(points_cm[:, 0], points_cm[:, 1] - lead_cm)


def pack_scans(frames: list[RoadEdges], camera_height_cm: float, lead_cm: float = 0.0) -> Scans:
    """Pack per-frame edge points, and weigh them by their distance.

    One pixel spans road in proportion to the squared distance, and the position of a far edge is worth less.
    The weight falls to one half at four camera heights, smoothly, so that far points still help with the
    heading.

    Args:
        frames: Edge points of each frame.
        camera_height_cm: Sets the scale.
        lead_cm: Of the camera, see :attr:`lanenet.geometry.camera.Mounting.lead_cm`.
    """
    counts = [len(frame.points_cm) for frame in frames]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points = np.concatenate([np.empty((0, 2)), *(frame.points_cm for frame in frames)])
    normals = np.concatenate([np.empty((0, 2)), *(frame.normals for frame in frames)])
    distance = distances_seen(points, lead_cm) / (_HALF_WEIGHT_HEIGHTS * camera_height_cm)
    return Scans(points, normals, 1.0 / (1.0 + distance**4), starts)


def thin_scan(scan: Scan, max_points: int, rng: np.random.Generator) -> Scan:
    """Return at most ``max_points`` of a frame's edge points, drawn evenly."""
    size = len(scan.weights)
    if size <= max_points:
        return scan
    chosen = np.sort(rng.choice(size, max_points, replace=False))
    return Scan(*(column[chosen] for column in scan))


def condense(scan: Scan, patch_cm: float, most: int) -> Scan:
    """Average the edge points of each patch and direction, and keep the heaviest averages.

    Near the car many pixels see one patch of road. A random choice of points would crowd there and leave
    little for the rest of the road.

    Args:
        scan: Edge points of a frame.
        patch_cm: Side of a patch.
        most: How many patches to keep.

    Returns:
        Weighted mean points, unit normals, and weights: the length of the sum of the weighted normals, so
        that normals that disagree weigh less.
    """
    weights = scan.weights
    # At most half of the slots of the hash table are taken, so that a search for a free one is short.
    slots = np.full(2 << max(len(weights), 1).bit_length(), -1, np.int64)
    sums, keys = np.zeros((len(weights), 5)), np.empty((len(weights), 2), np.int64)
    count = _add_up(scan, patch_cm, slots, keys, sums)
    weight, length = sums[:count, 0], np.hypot(sums[:count, 3], sums[:count, 4])
    kept = np.flatnonzero(length > 1e-9 * weight)
    if len(kept) > most:
        kept = np.sort(kept[np.argpartition(-length[kept], most)[:most]])
    mean, length = sums[kept], length[kept]
    return Scan(mean[:, 1:3] / mean[:, :1], mean[:, 3:5] / length[:, None], length)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _add_up(scan, patch_cm, slots, keys, sums):
    """Sum weight, weighted point and weighted normal of each patch and sector.

    Args:
        scan: Edge points.
        patch_cm: Side of a patch.
        slots: Which patch stands in each slot of a hash table, -1 for none; a power of two.
        keys: Filled: column, and row with sector, of each patch.
        sums: Filled.

    Returns:
        Number of patches.
    """
    points_cm, normals, weights = scan.points_cm, scan.normals, scan.weights
    count, mask = 0, len(slots) - 1
    for i in range(len(weights)):
        x, y, nx, ny, weight = points_cm[i, 0], points_cm[i, 1], normals[i, 0], normals[i, 1], weights[i]
        sector = int(np.rint(np.arctan2(ny, nx) * (_SECTORS / (2.0 * np.pi)))) % _SECTORS
        column, row = int(np.floor(x / patch_cm)), int(np.floor(y / patch_cm)) * _SECTORS + sector
        slot = (column * 40503 + row * 30011) & mask
        while slots[slot] >= 0 and (keys[slots[slot], 0] != column or keys[slots[slot], 1] != row):
            slot = (slot + 1) & mask
        patch = slots[slot]
        if patch < 0:
            patch = slots[slot] = count
            keys[count, 0], keys[count, 1] = column, row
            count += 1
        sums[patch, 0] += weight
        sums[patch, 1] += weight * x
        sums[patch, 2] += weight * y
        sums[patch, 3] += weight * nx
        sums[patch, 4] += weight * ny
    return count
