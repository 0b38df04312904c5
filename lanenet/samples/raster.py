"""Cells of a raster, marked point by point, and which lines of the lane it shows; compiled."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

#: Edge points this close to a line belong to it. Chosen: both borders of a wide tape and their blur.
LINE_REACH_CM = 4.0
#: Sine of the largest angle between a marking's border and its line. Chosen: 30 degrees.
_LEAN = 0.5
#: A line that marks cells over the first length can be seen; over less than the second it cannot. Chosen;
#: both borders of a tape count, so the first is 9 cm of it.
SEEN_CM, UNSEEN_CM = 18.0, 3.0


class Grid(NamedTuple):
    """A bird's-eye window, in the single precision of edge points and the double precision of labels."""

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
    """Mark the cell of a point; return whether it lies in the window and was not marked before.

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
    """Mark a straight edge without holes; return how many cells it added."""
    steps = 1 + int(np.hypot(bx - ax, by - ay) / (0.7 * grid.cell_cm))
    added = 0
    for k in range(steps + 1):
        t = k / steps
        if mark(raster, ax + t * (bx - ax), ay + t * (by - ay), grid):
            added += 1
    return added


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def near_lines(edges, left_cm, right_cm, out):
    """Find which lines edge points belong to, and which points go with a line that is missing.

    Bit 0 is set for points within ``LINE_REACH_CM`` of the left line, and for those that run along it farther
    to the left: other borders of the road, which would be taken for the line if it were missing. Bit 1 is set
    likewise for the right line. Bits 2 and 3 are set for points within ``LINE_REACH_CM`` that run along the
    line, as a marking's borders do, and not across it, as most other edges.
    """
    reach = LINE_REACH_CM * LINE_REACH_CM
    for k in range(len(edges)):
        x, y = edges[k, 0], edges[k, 1]
        found = 0
        for side in range(2):
            line = left_cm if side == 0 else right_cm
            nearest, outside, along = np.inf, False, False
            for j in range(len(line) - 1):
                ax, ay = line[j, 0], line[j, 1]
                bx, by = line[j + 1, 0] - ax, line[j + 1, 1] - ay
                length = bx * bx + by * by
                t = ((x - ax) * bx + (y - ay) * by) / length if length > 0.0 else 0.0
                t = min(max(t, 0.0), 1.0)
                square = (x - ax - t * bx) ** 2 + (y - ay - t * by) ** 2
                # NaN, where a polyline is broken, is never near.
                if square < nearest:
                    lean = edges[k, 2] * bx + edges[k, 3] * by
                    nearest, along = square, lean * lean <= _LEAN * _LEAN * length
                    outside = (bx * (y - ay) - by * (x - ax) > 0.0) == (side == 0)
            if nearest <= reach:
                found |= 5 << side if along else 1 << side
            elif outside and along:
                found |= 1 << side
        out[k] = found


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def count_cells(cells, lines):
    """Count a newly marked cell for the lines along which its point runs."""
    cells[0] += (lines >> 2) & 1
    cells[1] += lines >> 3


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def presence(cells, frames, line, grid):
    """Return 1 for a line that can be seen, 0 for one that cannot, NaN between or if its place is unknown."""
    known = False
    for k in range(frames.line_start[line], frames.line_start[line + 1]):
        known = known or not np.isnan(frames.lines_cm[k, 0])
    seen_cm = cells * grid.cell_cm
    if not known or UNSEEN_CM <= seen_cm < SEEN_CM:
        return np.nan
    return 1.0 if seen_cm >= SEEN_CM else 0.0
