"""Edges of things that are not lanes: boxes, cones, other cars, shadows, scratches and dirt."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from lanenet.learn.random_stream import next_amount, next_between, next_number, next_uniform
from lanenet.learn.raster_kernels import mark, mark_edge

#: Of every outline; a round one looks round enough with so many.
CORNERS = 12

_BOX_HALF_CM = ((1.5, 12.0), (1.5, 22.0))
_CONE_CM = (1.5, 6.0)
#: What stands is smeared away from the camera on the road, the more the taller.
_STRETCH = (1.0, 5.0)
_SHADOW_CM = (8.0, 50.0)
_SHADOW_SHARE, _CONE_SHARE = 0.3, 0.35
_SEGMENT_CM = (4.0, 40.0)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def draw_outline(rng, corners, grid):
    """Draw a closed outline within the window; answers whether it hides the road within it.

    Args:
        rng: Stream of random numbers.
        corners: Its corners, [cm], frame car, to be filled.
        grid: The window.
    """
    x = next_between(rng, grid.left_cm, grid.left_cm + grid.columns * grid.cell_cm)
    y = next_between(rng, grid.far_cm - grid.rows * grid.cell_cm, grid.far_cm)
    kind = next_uniform(rng)
    if kind < _SHADOW_SHARE:
        # Four corners, none of them right: a shadow, a stain, a rug. The road goes on below it.
        size, turn = next_between(rng, *_SHADOW_CM), next_between(rng, 0.0, 2.0 * np.pi)
        for k in range(CORNERS):
            if k % 3 == 0:
                angle = turn + 2.0 * np.pi * (k + next_between(rng, -1.0, 1.0)) / CORNERS
                radius = size * next_between(rng, 0.4, 1.0)
            corners[k, 0], corners[k, 1] = x + radius * np.cos(angle), y + radius * np.sin(angle)
        return False
    if kind < _SHADOW_SHARE + _CONE_SHARE:
        radius, stretch = next_between(rng, *_CONE_CM), next_between(rng, *_STRETCH)
        away = np.hypot(x, y)
        ax, ay = (x / away, y / away) if away > 0.0 else (0.0, 1.0)
        for k in range(CORNERS):
            angle = 2.0 * np.pi * k / CORNERS
            along, across = radius * np.sin(angle), radius * np.cos(angle)
            if along > 0.0:
                along *= stretch
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
    """Mark edges of things that are not lanes; ``count`` is how many cells the frame itself has marked."""
    for _ in range(next_number(rng, amounts.clutter_segments, amounts.limit)):
        _add_edge(rng, raster, _SEGMENT_CM[1], grid)
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
    """Mark a straight edge at a random place; answers how many cells it added."""
    width_cm, depth_cm = grid.columns * grid.cell_cm, grid.rows * grid.cell_cm
    x = grid.left_cm + width_cm * next_uniform(rng)
    y = grid.far_cm - depth_cm * next_uniform(rng)
    angle = next_between(rng, 0.0, np.pi)
    half = 0.5 * min(next_between(rng, _SEGMENT_CM[0], _SEGMENT_CM[1]), longest_cm)
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    return mark_edge(raster, x - dx, y - dy, x + dx, y + dy, grid)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _add_point(rng, raster, grid):
    """Mark a cell at a random place; answers how many cells that added."""
    x = grid.left_cm + grid.columns * grid.cell_cm * next_uniform(rng)
    y = grid.far_cm - grid.rows * grid.cell_cm * next_uniform(rng)
    return 1 if mark(raster, x, y, grid) else 0
