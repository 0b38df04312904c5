"""Fewer edge points that say the same: those of one small patch and one direction become one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_SECTORS = 4  # directions that are kept apart, so that both edges of a tape are


def condense(
    points_cm: Float[np.ndarray, "m 2"],
    normals: Float[np.ndarray, "m 2"],
    weights: Float[np.ndarray, "m"],
    patch_cm: float,
    most: int,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Take the points of each patch together, and of the patches the heaviest.

    Near the car many pixels see one patch of road; a random choice of them would say as little of the rest as
    it says of that patch.

    Args:
        points_cm: Edge points, frame car.
        normals: Their unit normals.
        weights: Trust in each.
        patch_cm: Side of a patch.
        most: How many patches to keep.

    Returns:
        Weighted mean points, unit normals, and weights: the length of the sum of the weighted normals, so
        that normals that disagree weigh less.
    """
    column, row = np.floor(points_cm / patch_cm).astype(np.int64).T
    sector = np.rint(np.arctan2(normals[:, 1], normals[:, 0]) * (_SECTORS / (2.0 * np.pi))).astype(np.int64)
    key = ((column << 24) + row) * _SECTORS + sector % _SECTORS
    _, patch = np.unique(key, return_inverse=True)

    def total(values: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n"]:
        return np.bincount(patch, values).astype(np.float64)

    weight = total(weights)
    normal = np.column_stack([total(weights * normals[:, 0]), total(weights * normals[:, 1])])
    length = np.hypot(normal[:, 0], normal[:, 1])
    kept = np.flatnonzero(length > 1e-9 * weight)
    if len(kept) > most:
        kept = np.sort(kept[np.argpartition(-length[kept], most)[:most]])
    point = np.column_stack([total(weights * points_cm[:, 0]), total(weights * points_cm[:, 1])])
    return point[kept] / weight[kept, None], normal[kept] / length[kept, None], length[kept]
