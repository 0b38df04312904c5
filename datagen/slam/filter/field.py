"""A likelihood field: blurred unit gradients of the mapped edges, scored by dot product.

A count of matched points prefers standing still; with directions, an edge only matches an edge that brightens
in the same direction. The grid wraps around: a cell holds the patch of road that was mapped there last.
Memory and cost per frame stay constant however long the drive is.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int32
from numba import njit

from datagen.slam.odometry.scans import Scan

#: Cells on each side of a point that it blurs into: two standard deviations of the blur, which is one cell.
_REACH = 2


class DirectionField(NamedTuple):
    """A wrapping grid of blurred, ageing unit vectors.

    Attributes:
        cell_cm: Side of a cell.
        memory_frames: Frames after which a cell has faded to 1/e.
        vectors: Sum of unit normals per cell, size x size x 2.
        owner: Which cell of the unbounded plane (ix, iy) each grid cell holds.
        seen: Frame at which the cell was last written; -1 where never.
    """

    cell_cm: float
    memory_frames: float
    vectors: Float32[np.ndarray, "s s 2"]
    owner: Int32[np.ndarray, "s s 2"]
    seen: Int32[np.ndarray, "s s"]

    @staticmethod
    def empty(cell_cm: float, size: int, memory_frames: float) -> DirectionField:
        """Return an empty field; ``size`` must be a power of two."""
        return DirectionField(
            cell_cm,
            memory_frames,
            np.zeros((size, size, 2), np.float32),
            np.zeros((size, size, 2), np.int32),
            np.full((size, size), -1, np.int32),
        )

    def insert(
        self,
        points_map_cm: Float[np.ndarray, "n 2"],
        normals_map: Float[np.ndarray, "n 2"],
        weights: Float[np.ndarray, "n"],
        frame: int,
    ) -> None:
        """Map the edge points of a frame, [cm], frame map."""
        _insert(self, points_map_cm, normals_map, weights, frame)

    def score(
        self,
        poses: Float[np.ndarray, "p 3"],
        wheelbase_cm: float,
        scan: Scan,
        frame: int,
    ) -> Float[np.ndarray, "p"]:
        """Score how well a frame's edges fit the map from each pose.

        Returns:
            Weighted sum over the points of normal . field, one number per pose; about the weighted number
            of matched points.
        """
        return np.asarray(_score(self, poses, wheelbase_cm, scan, frame))


@njit(cache=True, fastmath=True)
@no_type_check
def _insert(field, points, normals, weights, frame):
    vectors, owner, seen = field.vectors, field.owner, field.seen
    cell_cm, memory = field.cell_cm, field.memory_frames
    mask = vectors.shape[0] - 1
    for i in range(points.shape[0]):
        gx, gy = points[i, 0] / cell_cm, points[i, 1] / cell_cm
        cx, cy = int(np.floor(gx)), int(np.floor(gy))
        for iy in range(cy - _REACH, cy + _REACH + 1):
            for ix in range(cx - _REACH, cx + _REACH + 1):
                dx, dy = ix + 0.5 - gx, iy + 0.5 - gy
                w = weights[i] * np.exp(-0.5 * (dx * dx + dy * dy))
                a, b = iy & mask, ix & mask
                if seen[a, b] < 0 or owner[a, b, 0] != ix or owner[a, b, 1] != iy:
                    owner[a, b, 0], owner[a, b, 1] = ix, iy
                    vectors[a, b, 0] = 0.0
                    vectors[a, b, 1] = 0.0
                elif seen[a, b] != frame:
                    fade = np.exp((seen[a, b] - frame) / memory)
                    vectors[a, b, 0] *= fade
                    vectors[a, b, 1] *= fade
                seen[a, b] = frame
                vectors[a, b, 0] += w * normals[i, 0]
                vectors[a, b, 1] += w * normals[i, 1]


@njit(cache=True, fastmath=True)
@no_type_check
def _score(field, poses, wheelbase, scan, frame):
    vectors, owner, seen = field.vectors, field.owner, field.seen
    cell_cm, memory = field.cell_cm, field.memory_frames
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
                    a, b = (iy + jy) & mask, (ix + jx) & mask
                    if seen[a, b] >= 0 and owner[a, b, 0] == ix + jx and owner[a, b, 1] == iy + jy:
                        w = wy * (tx if jx else 1.0 - tx)
                        if seen[a, b] != frame:
                            w *= np.exp((seen[a, b] - frame) / memory)
                        vx += w * vectors[a, b, 0]
                        vy += w * vectors[a, b, 1]
            # Saturate: an edge that was seen often counts once.
            total += weights[i] * (nx * vx + ny * vy) / (1.0 + np.sqrt(vx * vx + vy * vy))
        scores[p] = total
    return scores
