"""Fewer edge points that say the same: those of one small patch and one direction become one."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

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
    # At most half of the slots are taken, so that a search for a free one is short.
    slots = np.full(2 << max(len(weights), 1).bit_length(), -1, np.int64)
    sums, keys = np.zeros((len(weights), 5)), np.empty((len(weights), 2), np.int64)
    count = _add_up(points_cm, normals, weights, patch_cm, slots, keys, sums)
    weight, length = sums[:count, 0], np.hypot(sums[:count, 3], sums[:count, 4])
    kept = np.flatnonzero(length > 1e-9 * weight)
    if len(kept) > most:
        kept = np.sort(kept[np.argpartition(-length[kept], most)[:most]])
    mean, length = sums[kept], length[kept]
    return mean[:, 1:3] / mean[:, :1], mean[:, 3:5] / length[:, None], length


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _add_up(points_cm, normals, weights, patch_cm, slots, keys, sums):
    """Sum weight, weighted point and weighted normal of each patch and sector.

    Args:
        points_cm: Edge points.
        normals: Their normals.
        weights: Their weights.
        patch_cm: Side of a patch.
        slots: Which patch stands in each slot of a hash table, -1 for none; a power of two.
        keys: Filled: column, and row with sector, of each patch.
        sums: Filled.

    Returns:
        Number of patches.
    """
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
