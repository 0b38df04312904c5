"""Cells of a raster, marked point by point in compiled loops."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit


class Grid(NamedTuple):
    """A bird's-eye window in the single precision that edge points have; labels have double."""

    left_cm: np.float32
    far_cm: np.float32
    cell_cm: np.float32
    rows: int
    columns: int
    label_left_cm: float
    label_right_cm: float


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def mark(raster, x_cm, y_cm, grid):
    """Mark the cell of a point; answers whether it lay in the window and was not marked before.

    In single precision, as :meth:`BirdseyeWindow.rasterise` does it with edge points.
    """
    column = (np.float32(x_cm) - grid.left_cm) / grid.cell_cm
    row = (grid.far_cm - np.float32(y_cm)) / grid.cell_cm
    if not (column >= 0.0 and column < grid.columns and row >= 0.0 and row < grid.rows):
        return False
    i, j = int(row), int(column)
    fresh = raster[i, j] == 0
    raster[i, j] = 255
    return fresh


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def mark_edge(raster, ax, ay, bx, by, grid):
    """Mark a straight edge without holes; answers how many cells it added."""
    steps = 1 + int(np.hypot(bx - ax, by - ay) / (0.7 * grid.cell_cm))
    added = 0
    for k in range(steps + 1):
        t = k / steps
        if mark(raster, ax + t * (bx - ax), ay + t * (by - ay), grid):
            added += 1
    return added
