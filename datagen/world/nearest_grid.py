"""Where to start looking for a point's place along the road: a grid of nearest samples."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from datagen.world.track import Track

_GRID_CELL_CM = 2.0
_GRID_MARGIN_CM = 10.0  # around the markings, for pixels that reach over from outside


def nearest_sample_grid(track: Track) -> tuple[Int[np.ndarray, "r c"], Float[np.ndarray, "3"]]:
    """Nearest sample of the centre line by cell, -1 away from the road; origin and cell of the grid."""
    reach_cm = _GRID_MARGIN_CM + max(
        (abs(m.offset_cm) + 0.5 * m.width_cm for m in track.markings), default=0.0
    )
    low = track.xy_cm.min(axis=0) - reach_cm - _GRID_CELL_CM
    columns, rows = np.ceil((track.xy_cm.max(axis=0) + reach_cm - low) / _GRID_CELL_CM).astype(int) + 1
    grid = np.full((rows, columns), -1, np.int32)
    _fill_grid(track.xy_cm, low[0], low[1], _GRID_CELL_CM, reach_cm, grid)
    return grid, np.array([low[0], low[1], _GRID_CELL_CM])


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill_grid(nodes_xy, origin_x, origin_y, cell, reach, grid):
    """Write into each cell within ``reach`` of the centre line the index of the nearest sample."""
    rows, columns = grid.shape
    best = np.full(grid.shape, 1e18)
    span = int(np.ceil(reach / cell)) + 1
    for i in range(nodes_xy.shape[0]):
        column0 = int(np.floor((nodes_xy[i, 0] - origin_x) / cell))
        row0 = int(np.floor((nodes_xy[i, 1] - origin_y) / cell))
        for row in range(max(0, row0 - span), min(rows, row0 + span + 1)):
            dy = origin_y + (row + 0.5) * cell - nodes_xy[i, 1]
            for column in range(max(0, column0 - span), min(columns, column0 + span + 1)):
                dx = origin_x + (column + 0.5) * cell - nodes_xy[i, 0]
                d = dx * dx + dy * dy
                if d < best[row, column] and d <= reach * reach:
                    best[row, column] = d
                    grid[row, column] = i
