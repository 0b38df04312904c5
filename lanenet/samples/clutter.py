"""Edges of things that do not bound the lane, compiled: objects, shadows, scratches, dashes in its middle."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from lanenet.samples.random_stream import next_amount, next_between, next_number, next_uniform
from lanenet.samples.raster import mark, mark_edge

# All ranges below are chosen: objects, shadows and markings as they occur on model roads, at 1:10.
#: Corners of every outline; enough for a round one.
CORNERS = 12

#: Half the width and half the length of a box.
_BOX_HALF_CM = ((1.5, 12.0), (1.5, 22.0))
#: Radius of a cone's foot, and how many times longer it appears: what stands is smeared away from the camera.
_CONE_CM, _SMEAR = (1.5, 6.0), (1.0, 5.0)
#: Radius of a shadow.
_SHADOW_CM = (8.0, 50.0)
#: Shares of shadows and of cones among the outlines; the rest are boxes.
_SHADOW_SHARE, _CONE_SHARE = 0.3, 0.35
#: Length of a straight edge.
_EDGE_CM = (4.0, 40.0)
#: Length of a dash and of the gap after it.
_DASH_CM, _GAP_CM = (5.0, 30.0), (5.0, 30.0)
#: Offset of the dashes from the middle of the lane, in lane widths.
_OFF_MIDDLE = 0.04


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def draw_outline(rng, corners, grid):
    """Draw a closed outline within the window; return whether it hides the road within it.

    Args:
        rng: Stream of random numbers.
        corners: Its corners, [cm], frame car; written.
        grid: The window.
    """
    x = next_between(rng, grid.left_cm, grid.left_cm + grid.columns * grid.cell_cm)
    y = next_between(rng, grid.far_cm - grid.rows * grid.cell_cm, grid.far_cm)
    kind = next_uniform(rng)
    if kind < _SHADOW_SHARE:
        # An irregular quadrangle: a shadow, a stain, a rug. The road can be seen below it.
        size, turn = next_between(rng, *_SHADOW_CM), next_between(rng, 0.0, 2.0 * np.pi)
        for k in range(CORNERS):
            if k % 3 == 0:
                angle = turn + 2.0 * np.pi * (k + next_between(rng, -1.0, 1.0)) / CORNERS
                radius = size * next_between(rng, 0.4, 1.0)
            corners[k, 0], corners[k, 1] = x + radius * np.cos(angle), y + radius * np.sin(angle)
        return False
    if kind < _SHADOW_SHARE + _CONE_SHARE:
        radius, smear = next_between(rng, *_CONE_CM), next_between(rng, *_SMEAR)
        away = np.hypot(x, y)
        ax, ay = (x / away, y / away) if away > 0.0 else (0.0, 1.0)
        for k in range(CORNERS):
            angle = 2.0 * np.pi * k / CORNERS
            along, across = radius * np.sin(angle), radius * np.cos(angle)
            if along > 0.0:
                along *= smear
            corners[k, 0], corners[k, 1] = x + along * ax - across * ay, y + along * ay + across * ax
        return True
    wide, long = next_between(rng, *_BOX_HALF_CM[0]), next_between(rng, *_BOX_HALF_CM[1])
    turn = next_between(rng, 0.0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    for k in range(CORNERS):
        quarter = k // 3
        along = long if quarter == 0 or quarter == 1 else -long
        across = wide if quarter == 0 or quarter == 3 else -wide
        corners[k, 0], corners[k, 1] = x + along * c - across * s, y + along * s + across * c
    return True


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def is_inside(x, y, corners):
    """Tell whether a point lies within a closed outline (even-odd rule)."""
    inside = False
    j = CORNERS - 1
    for k in range(CORNERS):
        if (corners[k, 1] > y) != (corners[j, 1] > y):
            cut = (corners[j, 0] - corners[k, 0]) * (y - corners[k, 1]) / (corners[j, 1] - corners[k, 1])
            if x < corners[k, 0] + cut:
                inside = not inside
        j = k
    return inside


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def mark_outline(raster, corners, grid):
    """Mark a closed outline."""
    for k in range(CORNERS):
        a, b = corners[k], corners[(k + 1) % CORNERS]
        mark_edge(raster, a[0], a[1], b[0], b[1], grid)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def add_clutter(rng, raster, count, grid, amounts):
    """Mark edges of things that are not lanes; ``count`` is the number of cells that the frame marked."""
    for _ in range(next_number(rng, amounts.clutter_segments, amounts.limit)):
        _add_edge(rng, raster, _EDGE_CM[1], grid)
    for _ in range(next_number(rng, amounts.clutter_points, amounts.limit)):
        _add_point(rng, raster, grid)
    wanted = next_amount(rng, amounts.clutter_share, amounts.limit) * count
    added, tries = 0, 0
    # A crowded raster has no room for more: stop trying.
    while added < wanted and tries < 2 * count:
        tries += 1
        if next_uniform(rng) < 0.1:
            added += _add_edge(rng, raster, (wanted - added) * grid.cell_cm, grid)
        else:
            added += _add_point(rng, raster, grid)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _add_edge(rng, raster, longest_cm, grid):
    """Mark a straight edge at a random place; return how many cells it added."""
    width_cm, depth_cm = grid.columns * grid.cell_cm, grid.rows * grid.cell_cm
    x = grid.left_cm + width_cm * next_uniform(rng)
    y = grid.far_cm - depth_cm * next_uniform(rng)
    angle = next_between(rng, 0.0, np.pi)
    half = 0.5 * min(next_between(rng, _EDGE_CM[0], _EDGE_CM[1]), longest_cm)
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    return mark_edge(raster, x - dx, y - dy, x + dx, y + dy, grid)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _add_point(rng, raster, grid):
    """Mark a cell at a random place; return how many cells that added."""
    x = grid.left_cm + grid.columns * grid.cell_cm * next_uniform(rng)
    y = grid.far_cm - grid.rows * grid.cell_cm * next_uniform(rng)
    return 1 if mark(raster, x, y, grid) else 0


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def middle_dashes(rng, frames, i):
    """Copy a line of a frame to the middle of its lane, in dashes; return their points, [cm], frame car.

    The line of which the frame shows more is copied, with its blur, gaps and range. There are none if the two
    lines are not sampled alike.

    Args:
        rng: Stream of random numbers.
        frames: :class:`lanenet.samples.kernels.Frames`.
        i: The frame.
    """
    dash, gap = next_between(rng, *_DASH_CM), next_between(rng, *_GAP_CM)
    phase, off = next_uniform(rng), next_between(rng, -_OFF_MIDDLE, _OFF_MIDDLE)
    first, last = frames.edge_start[i], frames.edge_start[i + 1]
    starts = frames.line_start
    n = starts[2 * i + 1] - starts[2 * i]
    if n < 2 or starts[2 * i + 2] - starts[2 * i + 1] != n:
        return np.empty((0, 2))
    along = np.zeros(2, np.int64)
    for k in range(first, last):
        along[0] += (frames.edge_lines[k] >> 2) & 1
        along[1] += frames.edge_lines[k] >> 3
    side = 0 if along[0] >= along[1] else 1
    line, other = starts[2 * i + side], starts[2 * i + 1 - side]
    distance = np.zeros(n)
    for j in range(1, n):
        step = np.hypot(
            frames.lines_cm[line + j, 0] - frames.lines_cm[line + j - 1, 0],
            frames.lines_cm[line + j, 1] - frames.lines_cm[line + j - 1, 1],
        )
        distance[j] = distance[j - 1] + (0.0 if np.isnan(step) else step)
    points, count = np.empty((along[side], 2)), 0
    for k in range(first, last):
        if not (frames.edge_lines[k] >> (2 + side)) & 1:
            continue
        x, y = frames.edges_cm[k, 0], frames.edges_cm[k, 1]
        nearest, at = np.inf, 0
        for j in range(n):
            # NaN, where a line is broken, is never near.
            square = (x - frames.lines_cm[line + j, 0]) ** 2 + (y - frames.lines_cm[line + j, 1]) ** 2
            if square < nearest:
                nearest, at = square, j
        if (distance[at] + phase * (dash + gap)) % (dash + gap) > dash:
            continue
        px = x + (0.5 + off) * (frames.lines_cm[other + at, 0] - frames.lines_cm[line + at, 0])
        py = y + (0.5 + off) * (frames.lines_cm[other + at, 1] - frames.lines_cm[line + at, 1])
        if not np.isnan(px + py):
            points[count, 0], points[count, 1] = px, py
            count += 1
    return points[:count]
