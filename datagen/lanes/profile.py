"""Density of edges over position along a path and offset from it, and the removal of zebra crossings.

A stripe of a crossing by itself looks like a dash, but has stripes close by on both sides. A lane line has
none, or on one side only, where it is double or runs beside a crossing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_opening, gaussian_filter1d, maximum_filter1d

from datagen.lanes.path import Path, PathEdges

#: Weight of edges in a cell at which its density is one half. Chosen: after smoothing, a line of one
#: point per path sample has the density 0.7, a single point 0.3.
_HALF_DENSITY = 0.15
#: Smoothing across the path, in cells. Chosen: the scatter of a border between frames (0.035 camera heights).
_ACROSS_CELLS = 1.2
#: Distance to the next stripe of a crossing, between like borders, in camera heights. Chosen: periods of 3 to
#: 9 cm at a camera height of 15 cm; stripes are about as wide as lane markings.
_PERIOD_HEIGHTS = (0.18, 0.6)
#: Least number of edges of a neighbouring stripe relative to the stripe itself. Chosen: stripes are alike,
#: clutter has fewer edges.
_AS_MANY = 0.5
#: Density of edges above which there is something. By definition half of saturation.
_PAINT = 0.5
#: Least length of a crossing's stripes, in camera heights. Chosen: half of the shortest usual stripe (20 cm).
_LONG_HEIGHTS = 0.5
#: Cells and smoothing along the path, in camera heights, and alignment, of the profile in which stripes are
#: found: as for lines, see :class:`datagen.lanes.markings.TraceSettings`.
_CELL_HEIGHTS, _ALONG_HEIGHTS, _MIN_SIDE = 0.03, 0.25, 0.75


@dataclass(frozen=True)
class EdgeProfile:
    """Density of edges over path position and offset.

    Attributes:
        cell_cm: Width of a column.
        half_cells: Columns on each side of the path; offset d is column half_cells + d / cell_cm.
        left: Edges that brighten to the right (left border of a bright marking), 0..1.
        right: Edges that brighten to the left (right border of a bright marking), 0..1.
    """

    cell_cm: float
    half_cells: int
    left: Float[np.ndarray, "m c"]
    right: Float[np.ndarray, "m c"]

    def tapes(self, width_cm: float) -> Float[np.ndarray, "m c"]:
        """Return the support of a marking of this width with its middle at each offset, 0..1."""
        return np.sqrt(
            shifted(self.left, 0.5 * width_cm / self.cell_cm)
            * shifted(self.right, -0.5 * width_cm / self.cell_cm)
        )

    def towards_dark(self) -> EdgeProfile:
        """Return the profile of the same edges with normals to the darker side."""
        return replace(self, left=self.right, right=self.left)

    def unsaturated(self) -> EdgeProfile:
        """Return the profile with numbers of edges in place of their densities."""
        return replace(self, left=_edges_of(self.left), right=_edges_of(self.right))


def edge_profile(
    path: Path, edges: PathEdges, cell_cm: float, half_cells: int, along_cm: float, min_side: float
) -> EdgeProfile:
    """Count edges that run along the path, by direction, in cells of position and offset.

    Counts saturate, so that a section where the car stood does not outweigh the rest.

    Args:
        path: The path.
        edges: Edge points in its coordinates.
        cell_cm: Width of a column.
        half_cells: Columns on each side of the path.
        along_cm: Smoothing along the path.
        min_side: Least component of an edge's normal across the path.
    """
    shape = (len(path.xy_cm), 2 * half_cells + 1)
    column = np.rint(edges.d_cm / cell_cm).astype(np.intp) + half_cells
    row = np.rint(edges.s_cm / path.step_cm).astype(np.intp)
    if path.closed:
        row %= shape[0]
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    profiles = []
    for sign in (-1.0, 1.0):
        along = inside & (sign * edges.side >= min_side)
        counts = np.bincount(
            row[along] * shape[1] + column[along], edges.weight[along], minlength=shape[0] * shape[1]
        )
        density = gaussian_filter1d(
            counts.astype(np.float64).reshape(shape), _ACROSS_CELLS, axis=1, mode="constant"
        )
        mode: Literal["wrap", "nearest"] = "wrap" if path.closed else "nearest"
        density = gaussian_filter1d(density, along_cm / path.step_cm, axis=0, mode=mode)
        profiles.append(density / (density + _HALF_DENSITY))
    return EdgeProfile(cell_cm, half_cells, profiles[0], profiles[1])


def shifted(image: Float[np.ndarray, "m c"], cells: float) -> Float[np.ndarray, "m c"]:
    """Return image[:, c + cells] with linear interpolation, zero outside."""
    whole = int(np.floor(cells))
    part = cells - whole
    padded = np.pad(image, ((0, 0), (abs(whole) + 1, abs(whole) + 1)))
    start, width = abs(whole) + 1 + whole, image.shape[1]
    return (1.0 - part) * padded[:, start : start + width] + part * padded[:, start + 1 : start + 1 + width]


def without_crossings(path: Path, edges: PathEdges, camera_height_cm: float, side_cm: float) -> PathEdges:
    """Remove the edges of stripes that have other stripes on both sides.

    Args:
        path: The path.
        edges: Edge points in its coordinates.
        camera_height_cm: Sets the scale of bounds.
        side_cm: Largest offset from the path at which stripes are looked for.
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
    striped = long_runs(striped, rows, path.closed)
    row = np.rint(edges.s_cm / path.step_cm).astype(np.intp) % len(striped)
    column = np.rint(edges.d_cm / cell).astype(np.intp) + half
    inside = (column >= 0) & (column <= 2 * half)
    kept = ~(inside & striped[row, np.where(inside, column, 0)])
    return edges.select(kept)


def _within(density: Float[np.ndarray, "m c"], low: int, high: int) -> Float[np.ndarray, "m c"]:
    """Highest density between two distances to the left of each cell, both in cells."""
    size = high - low + 1
    padded = np.pad(density, ((0, 0), (abs(low) + size, abs(high) + size)))
    highest = maximum_filter1d(padded, size, axis=1, mode="constant")
    first = abs(low) + size + low + size // 2
    return np.asarray(highest[:, first : first + density.shape[1]])


def _edges_of(density: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
    """Number of edges that gives a density; inverse of the saturation."""
    return density / np.maximum(1.0 - density, 1e-6)


def long_runs(mask: Bool[np.ndarray, "m c"], rows: int, closed: bool) -> Bool[np.ndarray, "m c"]:
    """Keep runs of at least that many rows in each column; if closed, a run may cross the seam."""
    mode: Literal["wrap", "constant"] = "wrap" if closed else "constant"
    padded = np.pad(mask, ((rows, rows), (0, 0)), mode=mode)
    return np.asarray(binary_opening(padded, np.ones((rows, 1), dtype=bool)))[rows:-rows]
