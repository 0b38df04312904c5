"""Stripes of zebra crossings: paint along the road that is no line of it.

A stripe by itself looks like a dash. What tells it is its company: stripes close by on both sides of it. A
line has none, or, where it is double or runs beside a crossing, on one side only.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_opening, maximum_filter1d

from datagen.lanes.path import Path, PathEdges
from datagen.lanes.profile import edge_profile

#: How far away the next stripe is, from border to like border, in camera heights.
_PERIOD_HEIGHTS = (0.18, 0.6)
#: Edges that the stripes on either side have at least, as a share of the own ones: clutter has fewer.
_AS_MANY = 0.5
#: Density of edges from which there is anything.
_PAINT = 0.5
#: Length of a crossing's stripes at least, in camera heights.
_LONG_HEIGHTS = 0.5
_CELL_HEIGHTS, _ALONG_HEIGHTS, _MIN_SIDE = 0.03, 0.25, 0.75


def without_crossings(path: Path, edges: PathEdges, camera_height_cm: float, side_cm: float) -> PathEdges:
    """Leave out the edges of stripes that have others on both sides.

    Args:
        path: The path.
        edges: Edge points in its coordinates.
        camera_height_cm: Sets the scale of bounds.
        side_cm: How far beside the path stripes are looked for.
    """
    cell = _CELL_HEIGHTS * camera_height_cm
    half = int(side_cm / cell)
    profile = edge_profile(path, edges, cell, half, _ALONG_HEIGHTS * camera_height_cm, _MIN_SIDE)
    both = (profile.left, profile.right)
    near, far = (round(heights / _CELL_HEIGHTS) for heights in _PERIOD_HEIGHTS)
    half_near = near // 2
    striped = np.ones(profile.left.shape, dtype=bool)
    own = np.maximum(*(_edges_of(_within(density, -half_near, half_near)) for density in both))
    for density in both:
        for low, high in ((near, far), (-far, -near)):
            beside = _within(density, low, high)
            striped &= (beside > _PAINT) & (_edges_of(beside) >= _AS_MANY * own)
    rows = max(2, round(_LONG_HEIGHTS * camera_height_cm / path.step_cm))
    striped = _opened(striped, rows, path.closed)
    row = np.rint(edges.s_cm / path.step_cm).astype(np.intp) % len(striped)
    column = np.rint(edges.d_cm / cell).astype(np.intp) + half
    inside = (column >= 0) & (column <= 2 * half)
    kept = ~(inside & striped[row, np.where(inside, column, 0)])
    return edges.part(kept)


def _within(density: Float[np.ndarray, "m c"], low: int, high: int) -> Float[np.ndarray, "m c"]:
    """Highest density between two distances to the left of each cell, in cells."""
    size = high - low + 1
    padded = np.pad(density, ((0, 0), (abs(low) + size, abs(high) + size)))
    highest = maximum_filter1d(padded, size, axis=1, mode="constant")
    first = abs(low) + size + low + size // 2
    return np.asarray(highest[:, first : first + density.shape[1]])


def _edges_of(density: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
    """Number of edges behind a density, which saturates."""
    return density / np.maximum(1.0 - density, 1e-6)


def _opened(mask: Bool[np.ndarray, "m c"], rows: int, closed: bool) -> Bool[np.ndarray, "m c"]:
    """Keep what is that many rows long."""
    mode: Literal["wrap", "constant"] = "wrap" if closed else "constant"
    padded = np.pad(mask, ((rows, rows), (0, 0)), mode=mode)
    return np.asarray(binary_opening(padded, np.ones((rows, 1), dtype=bool)))[rows:-rows]
