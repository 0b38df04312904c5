"""Density of edges over the position along a path and the offset from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.path import Path, PathEdges

#: Weight of edges in a cell at which it counts half.
_HALF_FULL = 0.15
#: Smoothing across the path, in cells.
_ACROSS_CELLS = 1.2


@dataclass(frozen=True)
class EdgeProfile:
    """Density of edges over path position and offset.

    Attributes:
        cell_cm: Width of a column.
        half_cells: Columns on each side of the path; offset d is column half_cells + d / cell_cm.
        left: Edges that brighten to the right (left side of a bright marking), m x columns, 0..1.
        right: Edges that brighten to the left (right side of a bright marking), m x columns, 0..1.
    """

    cell_cm: float
    half_cells: int
    left: Float[np.ndarray, "m c"]
    right: Float[np.ndarray, "m c"]

    def tapes(self, width_cm: float) -> Float[np.ndarray, "m c"]:
        """Return how well a marking of this width, with its middle at each offset, is supported."""
        return np.sqrt(
            shifted(self.left, 0.5 * width_cm / self.cell_cm)
            * shifted(self.right, -0.5 * width_cm / self.cell_cm)
        )


def edge_profile(
    path: Path, edges: PathEdges, cell_cm: float, half_cells: int, along_cm: float, min_side: float
) -> EdgeProfile:
    """Count edges that run along the path, per direction, in cells of path position and offset.

    Counts saturate, so that a stretch where the car stood does not outweigh the rest.

    Args:
        path: The path.
        edges: Edge points in its coordinates.
        cell_cm: Width of a column.
        half_cells: Columns on each side of the path.
        along_cm: Smoothing along the path.
        min_side: Component across the path that the normal of an edge along it has at least.
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
        profiles.append(density / (density + _HALF_FULL))
    return EdgeProfile(cell_cm, half_cells, profiles[0], profiles[1])


def shifted(image: Float[np.ndarray, "m c"], cells: float) -> Float[np.ndarray, "m c"]:
    """Return image[:, c + cells] with linear interpolation, zero outside."""
    whole = int(np.floor(cells))
    part = cells - whole
    padded = np.pad(image, ((0, 0), (abs(whole) + 1, abs(whole) + 1)))
    start, width = abs(whole) + 1 + whole, image.shape[1]
    return (1.0 - part) * padded[:, start : start + width] + part * padded[:, start + 1 : start + 1 + width]
